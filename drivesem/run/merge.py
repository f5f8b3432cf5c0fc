"""Parts of one attack, made on several machines, as one run."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from drivesem.attack.space import parse_params
from drivesem.config.commands import AttackConfig
from drivesem.config.errors import UsageError
from drivesem.run.attack import WRITTEN, summarise_run, write_run_summary
from drivesem.run.finished import MANIFEST, METRICS, AttackRun, load_runs
from drivesem.run.folder import FRAMES, claim_folder, load_run_detector, load_trusted_config, result_settings
from drivesem.run.frame import RESULT
from drivesem.run.manifest import hash_json
from drivesem.run.records import from_json
from drivesem.run.results import RunSummary
from scene_ir import files
from scene_ir.errors import FormatError


def merge_runs(folders: Sequence[str], out: Path, trust: bool) -> RunSummary:
    """Make one run in the folder `out` of the frames of several finished ones with the same settings, or go on
    with it. Frames that are the same in two of them count once. `out` may be one of them. trust: see
    `trusted_attack`.

    Raises UsageError for runs that are no parts of one, FormatError naming a file that is damaged.
    """
    files.check_utf8("--out", str(out))
    parts = load_runs(folders, setting="FOLDER", may_be_empty=True)
    if not any(part.frames for part in parts):
        raise UsageError("FOLDER", "runs with frames", f"none in {', '.join(folders)}")
    attacks = [load_trusted_config(part.folder, trust, "FOLDER") for part in parts]
    for part, attack in zip(parts, attacks, strict=True):
        _check_alike(parts[0], attacks[0], part, attack)
    # Whatever the first was told of frames that are there: those of `out` stay, which may be a part's own.
    config = replace(attacks[0], out=str(out), part=None, limit=None, resume=True)
    claim_folder(out, config, WRITTEN)
    results = {}
    for part in parts:
        for frame in part.frames:
            name = frame.result.identifier
            there = (out / FRAMES / name / RESULT).is_file()
            if there and _told(frame.folder) != _told(out / FRAMES / name):
                if name in results:
                    raise UsageError("FOLDER", "runs in which a frame is the same", f"two results of frame {name}")
                raise UsageError("--out", "a new folder, or one of the same frames", f"another {name} in {out}")
            if not there:
                with files.atomic_folder(out / FRAMES / name) as whole:
                    shutil.copytree(frame.folder, whole, dirs_exist_ok=True, copy_function=_link_or_copy)
            results[name] = frame.result
    ordered = [results[name] for name in sorted(results)]
    metrics = [files.read_json(part.folder / METRICS) for part in parts]
    emptied = [_emptied(part.folder) for part in parts]
    try:
        failed = {name: str(why) for figures in metrics for name, why in figures["frames_failed"].items()}
        # Each part passed over all frames without vehicles, and found for itself which cannot be taken apart.
        counts = [int(figures["frames_without_vehicles"]) for figures in metrics]
        passed_over = max(count - len(own) for count, own in zip(counts, emptied, strict=True))
        seconds = round(sum(float(figures["seconds"]) for figures in metrics), 3)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise FormatError(METRICS, "frames_failed, frames_without_vehicles and seconds", error) from error
    failed = {name: why for name, why in sorted(failed.items()) if name not in results}
    detector = load_run_detector(config, config.device, "FOLDER")
    summary = summarise_run(config, parse_params(parts[0].params), detector, ordered)
    empty = set().union(*emptied)
    without = passed_over + len(empty)
    summary = replace(summary, frames_failed=failed, frames_without_vehicles=without, seconds=seconds)
    return write_run_summary(out, config, summary, ordered, empty)


def _check_alike(first: AttackRun, wanted: AttackConfig, part: AttackRun, attack: AttackConfig) -> None:
    one, other = result_settings(wanted), result_settings(attack)
    if one != other:
        changed = ", ".join(key for key, value in one.items() if other[key] != value)
        raise UsageError(
            "FOLDER", f"runs with the settings of {first.folder}", f"{part.folder}: another {changed}"
        )


def _emptied(run: Path) -> set[str]:
    """Frames of a run of whose vehicles none could be taken apart; none are known of runs of earlier versions."""
    told = files.read_json(run / MANIFEST).get("empty", [])
    return set(from_json(tuple[str, ...], told, f"{run / MANIFEST}: empty"))


def _told(frame: Path) -> str:
    return hash_json(files.read_json(frame / RESULT))


def _link_or_copy(source: str, target: str) -> None:
    """Files of runs are replaced and never written into: a second name for one is as good as a copy."""
    try:
        os.link(source, target)
    except OSError:  # another file system, or one without links
        shutil.copy2(source, target)
