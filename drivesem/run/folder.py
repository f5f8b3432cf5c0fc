"""Claims the output folder of a run, new or with the same settings, and loads the settings of finished runs."""

from __future__ import annotations

import re
import shutil
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from detectors.base import DetectorError, Predictor
from detectors.registry import find_code_to_run, load_predictor
from drivesem.attacks.targets import EvaluatedClasses
from drivesem.config.commands import AttackConfig
from drivesem.config.errors import UsageError
from drivesem.config.options import OutputOptions, to_yaml
from drivesem.run.lock import LOCK, acquire_folder_lock
from drivesem.run.records import from_json
from scene_ir import files

CONFIG = "config.yaml"
"""File of the resolved settings."""
REFERENCED_FILES = "files.json"
"""File of the digests of files that the settings name."""
PLAN = "plan.json"
"""File of the number of frames that a run of `drivesem attack` will have."""
FRAMES = "frames"
"""Folder of the frames of a run or an analysis."""
SHARING = ("workers", "engine", "address", "keep_going")
"""Settings of workers."""
ARMS, HELD_OUT, RETRAINED = "arms", "held-out", "retrained"
"""In the folder of a study: folder of its runs, name of the run on held-out frames, folder of retrained detectors.
"""
PRESENTATION = (
    *SHARING,
    "out",
    "limit",
    "part",
    "resume",
    "json",
    "cache",
    "cache_gb",
    "incremental",
    "trust",
)
"""Settings that do not affect a frame's result, so a run may be resumed with others."""


def claim_folder(
    out: Path,
    config: OutputOptions,
    written: Iterable[str],
    presentation: Collection[str] = PRESENTATION,
    renews: bool = False,
) -> None:
    """Claim and lock `out` for this run, and write its settings.

    Args:
        out: The folder; new, or of an earlier run with the same settings.
        config: The settings.
        written: Files and folders that a run writes; --no-resume removes them, and nothing else.
        presentation: Settings that may differ from the earlier run.
        renews: Also remove them if a file that the settings name, such as weights, has changed.

    Raises:
        UsageError: `out` is a file, holds other files or a run with other settings, or is in use.
    """
    path = out / CONFIG
    resolve_output_folder(None, out)
    if out.is_dir() and not path.exists() and any(file.name != LOCK for file in out.iterdir()):
        raise UsageError("--out", "a new folder, or one of an earlier run", f"{out}, which holds other files")
    acquire_folder_lock(out)
    digests = _digest_referenced_files(config, presentation)
    if path.exists():
        if config.resume:
            _check_same_settings(path, config, presentation)
        changed = _changed_files(out, digests) if config.resume else []
        if changed and not renews:
            expected = "the files of this run (else another --out, or --no-resume)"
            raise UsageError(str(out / REFERENCED_FILES), expected, f"other contents of {', '.join(changed)}")
        if changed or not config.resume:
            _remove(out / name for name in written)
    files.write_text(path, to_yaml(config))
    if digests:
        files.write_json(out / REFERENCED_FILES, digests)


def _digest_referenced_files(config: OutputOptions, presentation: Collection[str]) -> dict[str, str]:
    """Return digests of the files that settings name, such as weights, by that name."""
    values = [value for value in result_settings(config, presentation).values() if isinstance(value, str)]
    words = {word for value in values for word in (value, *re.split("[,:]", value)) if word}
    return {word: files.sha256_digest(Path(word)) for word in sorted(words) if Path(word).is_file()}


def _changed_files(folder: Path, digests: Mapping[str, str]) -> list[str]:
    """Return the files that have changed since the folder was claimed."""
    path = folder / REFERENCED_FILES
    before = files.read_json(path) if path.is_file() else {}
    earlier = before if isinstance(before, dict) else {}
    return [name for name, digest in digests.items() if earlier.get(name, digest) != digest]


def check_referenced_files(run: Path, config: OutputOptions) -> None:
    """Raise UsageError if a file that a run's settings name has changed since the run."""
    changed = _changed_files(run, _digest_referenced_files(config, PRESENTATION))
    if changed:
        raise UsageError(
            str(run / REFERENCED_FILES), "the files that this run was made with", f"another {', '.join(changed)}"
        )


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def resolve_output_folder(given: str | None, default: Path) -> Path:
    """Return the folder that --out names, or the default. Raises UsageError for a file."""
    out = Path(given) if given else default
    if out.exists() and not out.is_dir():
        raise UsageError("--out", "a folder", f"the file {out}")
    return out


def is_attack_run(run: Path) -> bool:
    """Whether a run's settings are those of `drivesem attack`."""
    loaded = files.read_yaml(run / CONFIG)
    return isinstance(loaded, dict) and set(loaded) <= {field.name for field in fields(AttackConfig)}


def load_attack_config(run: Path, setting: str = "--run") -> AttackConfig:
    """Load the settings of a run of `drivesem attack`. setting: option that names the run.

    Raises UsageError if the folder holds no such run.
    """
    path = run / CONFIG
    if not path.is_file():
        raise UsageError(setting, "a run's folder, with its config.yaml", run)
    if not is_attack_run(run):
        raise UsageError(setting, "a run of drivesem attack", run)
    attack: AttackConfig = from_json(AttackConfig, files.read_yaml(path), str(path))
    try:
        # the run that a placebo imitates may be gone
        replace(attack, like=attack.like and str(run)).check()
    except UsageError as error:
        raise UsageError(f"{path}: {error.field}", error.expected, error.actual) from error
    return attack


def load_trusted_config(run: Path, trust: bool, setting: str = "--run") -> AttackConfig:
    """Load the settings of a run before loading its detectors, as the settings may name code of unknown origin.

    Args:
        run: Folder of the run.
        trust: Whether that code may run.
        setting: Option that names the run.

    Raises:
        UsageError: The folder holds no run, a file has changed, or code is not trusted.
    """
    attack = load_attack_config(run, setting)
    for setting in ("detector", "second_detector", "reference_detector"):
        code = find_code_to_run(getattr(attack, setting) or "")
        if code is not None and not trust:
            expected = f"a detector that is data alone, or --trust, which lets this run the code in {code}"
            raise UsageError(f"{run / CONFIG}: {setting}", expected, getattr(attack, setting))
    check_referenced_files(run, attack)
    return attack


def load_run_detector(attack: AttackConfig, device: str, setting: str = "--run") -> Predictor:
    """Load a run's detector in float32, which runs evaluate in at any precision of gradients.

    Args:
        attack: The run's settings.
        device: Device of the detector.
        setting: Option that names the run.

    Raises:
        UsageError: It cannot be loaded, or has no class of vehicles.
    """
    try:
        detector = load_predictor(attack.detector, device, attack.tiles)
        EvaluatedClasses.from_detector(detector)
    except DetectorError as error:
        raise UsageError.from_detector_error(setting, "a run with a detector that can be loaded", error) from error
    return detector


def result_settings(config: OutputOptions, presentation: Collection[str] = PRESENTATION) -> dict[str, Any]:
    """Return the settings that may affect a frame's result."""
    return {key: value for key, value in asdict(config).items() if key not in presentation}


def _check_same_settings(path: Path, config: OutputOptions, presentation: Collection[str]) -> None:
    before = files.read_yaml(path)
    before = before if isinstance(before, dict) else {}
    wanted = result_settings(config, presentation)
    if {key: value for key, value in before.items() if key not in presentation} != wanted:
        changed = [
            key for key in {**before, **wanted} if before.get(key) != wanted.get(key) and key not in presentation
        ]
        raise UsageError(
            str(path),
            "the settings of this run (else another --out, or --no-resume)",
            "other values of " + ", ".join(changed),
        )
