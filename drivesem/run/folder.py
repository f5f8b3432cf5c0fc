"""The folder of a run: new, or one with the same settings to go on in."""

from __future__ import annotations

import re
import shutil
from collections.abc import Collection, Iterable, Mapping
from dataclasses import MISSING, asdict, fields, replace
from pathlib import Path
from typing import Any

from detectors.base import DetectorError, Predictor
from detectors.registry import find_code_to_run, load_predictor
from drivesem.attack.targets import EvaluatedClasses
from drivesem.config.commands import AttackConfig
from drivesem.config.errors import UsageError
from drivesem.config.options import OutputOptions, to_yaml
from drivesem.run.lock import LOCK, acquire_folder_lock
from drivesem.run.records import from_json
from scene_ir import files

CONFIG = "config.yaml"
"""The resolved settings, in the run's folder."""
REFERENCED_FILES = "files.json"
"""Digests of the files that these name."""
FRAMES = "frames"
"""Folder of the frames in a run's folder, and of what a question keeps of each."""
SHARING = ("workers", "engine", "address", "keep_going")
"""Settings of who shares the frames."""
ARMS, HELD_OUT, RETRAINED = "arms", "held-out", "retrained"
"""In a study's folder: that of its runs, the name of the run on held-out frames against the detector that is
retrained, and the folder of retrained detectors."""
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
"""Settings that change no frame's result: a run may be continued with others."""


def claim_folder(
    out: Path,
    config: OutputOptions,
    written: Iterable[str],
    presentation: Collection[str] = PRESENTATION,
    renews: bool = False,
) -> None:
    """Make `out` this run's folder, and hold it. written: names of the files and folders in it that an earlier run
    wrote, which --no-resume removes, and nothing else; renews: so does a file that the settings name, such as
    weights, where it holds something else than before.

    Raises UsageError where `out` is a file, holds other files, a run whose settings or files were others, or what
    another process is writing.
    """
    path = out / CONFIG
    resolve_output_folder(None, out)
    if out.is_dir() and not path.exists() and any(file.name != LOCK for file in out.iterdir()):
        raise UsageError("--out", "a new folder, or one of an earlier run", f"{out}, which holds other files")
    acquire_folder_lock(out)
    named = _named(config, presentation)
    if path.exists():
        if config.resume:
            _check_settings(path, config, presentation)
        other = _others(out, named) if config.resume else []
        if other and not renews:
            expected = "the files of this run (else another --out, or --no-resume)"
            raise UsageError(str(out / REFERENCED_FILES), expected, f"another content of {', '.join(other)}")
        if other or not config.resume:
            _remove(out / name for name in written)
    files.write_text(path, to_yaml(config))
    if named:
        files.write_json(out / REFERENCED_FILES, named)


def _named(config: OutputOptions, presentation: Collection[str]) -> dict[str, str]:
    """Digests of the files that settings name, such as weights, by how they name them."""
    values = [value for value in result_settings(config, presentation).values() if isinstance(value, str)]
    words = {word for value in values for word in (value, *re.split("[,:]", value)) if word}
    return {word: files.sha256_digest(Path(word)) for word in sorted(words) if Path(word).is_file()}


def _others(folder: Path, named: Mapping[str, str]) -> list[str]:
    """Which of the files hold something else than when the folder was claimed."""
    path = folder / REFERENCED_FILES
    before = files.read_json(path) if path.is_file() else {}
    known = before if isinstance(before, dict) else {}
    return [word for word, digest in named.items() if known.get(word, digest) != digest]


def check_referenced_files(run: Path, config: OutputOptions) -> None:
    """UsageError where a file that a run's settings name is no longer the one that the run was made with."""
    other = _others(run, _named(config, PRESENTATION))
    if other:
        raise UsageError(
            str(run / REFERENCED_FILES), "the files that this run was made with", f"another {', '.join(other)}"
        )


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def resolve_output_folder(given: str | None, default: Path) -> Path:
    """The folder that --out names, or the default. Raises UsageError for a file."""
    out = Path(given) if given else default
    if out.exists() and not out.is_dir():
        raise UsageError("--out", "a folder", f"the file {out}")
    return out


def is_attack_run(run: Path) -> bool:
    """Whether the settings of a run are those of `drivesem attack`, and not of another command."""
    loaded = files.read_yaml(run / CONFIG)
    return isinstance(loaded, dict) and set(loaded) <= {field.name for field in fields(AttackConfig)}


def load_attack_config(run: Path, setting: str = "--run") -> AttackConfig:
    """The configuration of a run of `drivesem attack`. setting: what names it on the command line. Raises
    UsageError where the folder is none.
    """
    path = run / CONFIG
    if not path.is_file():
        raise UsageError(setting, "a run's folder, with its config.yaml", run)
    if not is_attack_run(run):
        raise UsageError(setting, "a run of drivesem attack", run)
    attack: AttackConfig = from_json(AttackConfig, files.read_yaml(path), str(path))
    try:
        # The run that a placebo was like may be gone.
        replace(attack, like=attack.like and str(run)).check()
    except UsageError as error:
        raise UsageError(f"{path}: {error.field}", error.expected, error.actual) from error
    return attack


def load_trusted_config(run: Path, trust: bool, setting: str = "--run") -> AttackConfig:
    """The same, to load its detectors: a run comes from anywhere, and so would code that its settings name.
    trust: whether that may run. Raises UsageError as `attack_of`, and where it may not.
    """
    attack = load_attack_config(run, setting)
    for setting in ("detector", "peer", "witness"):
        code = find_code_to_run(getattr(attack, setting) or "")
        if code is not None and not trust:
            expected = f"a detector that is data alone, or --trust, which lets this run the code in {code}"
            raise UsageError(f"{run / CONFIG}: {setting}", expected, getattr(attack, setting))
    check_referenced_files(run, attack)
    return attack


def load_run_detector(attack: AttackConfig, device: str, setting: str = "--run") -> Predictor:
    """The run's detector, in float32, in which a run judges too whatever it took its gradients in.

    setting: what names the run on the command line. Raises UsageError where it cannot be had, or knows no cars.
    """
    try:
        detector = load_predictor(attack.detector, device, attack.tiles)
        EvaluatedClasses.from_detector(detector)
    except DetectorError as error:
        raise UsageError.from_detector_error(setting, "a run whose detector can be had", error) from error
    return detector


def result_settings(config: OutputOptions, presentation: Collection[str] = PRESENTATION) -> dict[str, Any]:
    """The settings that may change a frame's result, by name."""
    return {key: value for key, value in asdict(config).items() if key not in presentation}


def _check_settings(path: Path, config: OutputOptions, presentation: Collection[str]) -> None:
    before = files.read_yaml(path)
    # A setting that came with a later version had its default before.
    defaults = {f.name: f.default for f in fields(config) if f.default is not MISSING}
    known = defaults | before if isinstance(before, dict) else {}
    wanted = result_settings(config, presentation)
    if {key: value for key, value in known.items() if key not in presentation} != wanted:
        changed = [key for key, value in wanted.items() if known.get(key) != value]
        raise UsageError(
            str(path),
            "the settings of this run (else another --out, or --no-resume)",
            "other values of " + ", ".join(changed),
        )
