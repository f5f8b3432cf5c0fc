"""Merges parts of one attack, made on several machines, into one run."""

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
    """Merge finished runs with the same settings, or resume. Equal frames count once.

    Args:
        folders: Folders of the runs.
        out: Folder of the merged run; may be one of them.
        trust: Whether code that the settings name may run.

    Raises:
        UsageError: The runs have different settings or results.
        FormatError: A file is damaged.
    """
    files.check_utf8("--out", str(out))
    parts = load_runs(folders, setting="FOLDER", may_be_empty=True)
    if not any(part.frames for part in parts):
        raise UsageError("FOLDER", "runs with frames", f"none in {', '.join(folders)}")
    attacks = [load_trusted_config(part.folder, trust, "FOLDER") for part in parts]
    for part, attack in zip(parts, attacks, strict=True):
        _check_equal_settings(parts[0], attacks[0], part, attack)
    # always resume: `out` may be one of the parts
    config = replace(attacks[0], out=str(out), part=None, limit=None, resume=True)
    claim_folder(out, config, WRITTEN)
    results = {}
    for part in parts:
        for frame in part.frames:
            name = frame.result.identifier
            exists = (out / FRAMES / name / RESULT).is_file()
            if exists and _digest_result(frame.folder) != _digest_result(out / FRAMES / name):
                if name in results:
                    raise UsageError("FOLDER", "runs in which a frame is the same", f"two results of frame {name}")
                raise UsageError("--out", "a new folder, or one of the same frames", f"another {name} in {out}")
            if not exists:
                with files.atomic_folder(out / FRAMES / name) as whole:
                    shutil.copytree(frame.folder, whole, dirs_exist_ok=True, copy_function=_link_or_copy)
            results[name] = frame.result
    ordered = [results[name] for name in sorted(results)]
    metrics = [files.read_json(part.folder / METRICS) for part in parts]
    empty_by_part = [_frames_without_vehicles(part.folder) for part in parts]
    try:
        failed = {name: str(why) for part in metrics for name, why in part["frames_failed"].items()}
        # each part counts all frames without labelled vehicles, and those of its own without a de-rendered one
        counts = [int(part["frames_without_vehicles"]) for part in metrics]
        skipped = max(count - len(own) for count, own in zip(counts, empty_by_part, strict=True))
        seconds = round(sum(float(part["seconds"]) for part in metrics), 3)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise FormatError(METRICS, "frames_failed, frames_without_vehicles and seconds", error) from error
    failed = {name: why for name, why in sorted(failed.items()) if name not in results}
    detector = load_run_detector(config, config.device, "FOLDER")
    summary = summarise_run(config, parse_params(parts[0].params), detector, ordered)
    empty = set().union(*empty_by_part)
    without = skipped + len(empty)
    summary = replace(summary, frames_failed=failed, frames_without_vehicles=without, seconds=seconds)
    return write_run_summary(out, config, summary, ordered, empty)


def _check_equal_settings(first: AttackRun, wanted: AttackConfig, part: AttackRun, attack: AttackConfig) -> None:
    one, other = result_settings(wanted), result_settings(attack)
    if one != other:
        changed = ", ".join(key for key, value in one.items() if other[key] != value)
        raise UsageError(
            "FOLDER", f"runs with the settings of {first.folder}", f"{part.folder}: another {changed}"
        )


def _frames_without_vehicles(run: Path) -> set[str]:
    """Return the frames of a run in which no vehicle could be de-rendered."""
    empty = files.read_json(run / MANIFEST).get("empty", [])
    return set(from_json(tuple[str, ...], empty, f"{run / MANIFEST}: empty"))


def _digest_result(frame: Path) -> str:
    return hash_json(files.read_json(frame / RESULT))


def _link_or_copy(source: str, target: str) -> None:
    """Link a file, as files of runs are replaced and never modified, or copy it."""
    try:
        os.link(source, target)
    except OSError:  # another file system, or one without links
        shutil.copy2(source, target)
