"""Recomputes every frame of a run from its files and compares."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from drivesem.analysis.verify.checks import CHECKS, CheckLog, Mismatch
from drivesem.analysis.verify.frame import (
    BOX_PX,
    DRAWS,
    LABEL,
    LEVELS,
    SCORE,
    FrameCheck,
    RecordedSettings,
    check_frame,
)
from drivesem.attack.budgets import parse_budget
from drivesem.attack.targets import TargetSelection, resolve_t_star
from drivesem.config.commands import VerifyConfig
from drivesem.config.errors import UsageError
from drivesem.run.attack import build_grader, resolve_parameters, summarise_run
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.run.finished import MANIFEST, METRICS, AttackRun, load_runs
from drivesem.run.folder import CONFIG, FRAMES, load_run_detector, load_trusted_config, result_settings
from drivesem.run.manifest import HASHED_RUN_FIELDS, hash_fields, hash_json
from drivesem.run.records import from_json
from scene_ir import files
from scene_ir.errors import FormatError

WHOLE_RUN = "(run)"
"""Stands for the name of a frame in differences of the run as a whole."""
_NOT_COMPUTED = ("schema", "out", "seconds", "frames_without_vehicles", "frames_failed")
"""Keys of metrics.json that do not follow from the frames. The last two are part of its hash."""
_ROUNDING = 1e-9


def run_verify(config: VerifyConfig) -> tuple[dict[str, Any], Path]:
    """Verify a run, and write the report. Returns its data and file. Raises UsageError or SceneError for bad
    input.
    """
    (run,) = load_runs([config.run or ""])
    make_verifier = partial(FrameVerifier, config, run)
    verifier = make_verifier()
    out = Path(config.out) if config.out else run.folder / "verify.json"
    if out.is_dir():
        raise UsageError("--out", "a file", f"the folder {out}")
    names = [frame.result.identifier for frame in run.frames][: config.limit]
    progress_settings = ProgressSettings("checking frames", keep=False)
    jobs = run_frame_jobs(names, verifier, make_verifier, config, progress_settings)
    checks = [jobs.results[name] for name in names if name in jobs.results]
    data = _to_json(run, checks, _check_totals(run, verifier), jobs.failed)
    files.write_json(out, data)
    return data, out


class FrameVerifier:
    """Verifies frames of a run; made once per process."""

    def __init__(self, config: VerifyConfig, run: AttackRun) -> None:
        attack = load_trusted_config(run.folder, config.trust)
        detector = load_run_detector(attack, config.device)
        self.run, self.attack = run, attack
        self.manifest = RunManifest.read(run.folder / MANIFEST)
        self.settings = RecordedSettings(
            detector=detector,
            device=config.device,
            backend=attack.backend,
            params=resolve_parameters(attack),
            budget=parse_budget(attack.budget),
            parametrisation=attack.parametrisation,
            aim=TargetSelection.from_options(attack.target_objects, attack.target_classes),
            t_star=resolve_t_star(detector, attack.t_star),
            hashes=self.manifest.frames,
            field_hashes=self.manifest.frame_fields,
            grader=build_grader(replace(attack, confirm=False), detector),
        )

    def __call__(self, name: str) -> FrameCheck:
        """Verify one frame."""
        return check_frame(name, self.run.folder / FRAMES / name, self.settings)


@dataclass(frozen=True, slots=True)
class RunManifest:
    """Settings and hashes in a run's manifest.json."""

    settings: Mapping[str, Any]
    """The run's settings."""
    metrics: str
    """Hash of metrics.json."""
    frames: Mapping[str, Mapping[str, str]]
    """Hashes by frame and file."""
    run_fields: Mapping[str, str]
    """Hashes of values in metrics.json."""
    frame_fields: Mapping[str, Mapping[str, str]]
    """Hashes of values in result.json, by frame."""

    @classmethod
    def read(cls, path: Path) -> RunManifest:
        """Read a manifest. Raises FormatError if it is damaged."""
        data = files.read_json(path)
        frames, settings = data.get("frames"), data.get("settings")
        if not isinstance(frames, dict) or not all(isinstance(part, dict) for part in frames.values()):
            raise FormatError(f"{path}: frames", "hashes by frame and file", "something else")
        if not isinstance(settings, dict):
            raise FormatError(f"{path}: settings", "settings by name", type(settings).__name__)
        fields = from_json(_ManifestFields, data.get("fields", {}), f"{path}: fields")
        return cls(settings, data.get("metrics"), frames, fields.run, fields.frames)


@dataclass(frozen=True, slots=True)
class _ManifestFields:
    run: dict[str, str] = field(default_factory=dict)
    frames: dict[str, dict[str, str]] = field(default_factory=dict)


def _check_totals(run: AttackRun, verifier: FrameVerifier) -> CheckLog:
    """Compare config.yaml with the manifest, and metrics.json with the run's frames."""
    log, metrics, manifest = CheckLog(), files.read_json(run.folder / METRICS), verifier.manifest
    log.compare("files", METRICS, manifest.metrics, hash_json(metrics))
    log.compare_values("files", METRICS, manifest.run_fields, hash_fields(metrics, HASHED_RUN_FIELDS))
    settings, expected_settings = result_settings(verifier.attack), dict(manifest.settings)
    for name in sorted(settings.keys() | expected_settings.keys()):
        log.compare("settings", f"{CONFIG}: {name}", settings.get(name), expected_settings.get(name))
    results = [frame.result for frame in run.frames]
    params, detector = verifier.settings.params, verifier.settings.detector
    computed = summarise_run(verifier.attack, params, detector, results).to_json()
    for name in _NOT_COMPUTED:
        del computed[name]
    recorded = dict(_flatten("", metrics))
    for name, value in _flatten("", computed):
        expected = recorded.get(name)
        log.record("totals", f"{METRICS}: {name}", expected, value, agrees=_is_equal(expected, value))
    return log


def _flatten(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the values of a nested object with their paths."""
    if isinstance(value, dict) and value:
        for key, part in value.items():
            yield from _flatten(f"{name}.{key}" if name else key, part)
    else:
        yield name, value


def _is_equal(expected: Any, value: Any) -> bool:
    """Compare exactly, but floats up to rounding."""
    numbers = isinstance(expected, int | float) and isinstance(value, float)
    return math.isclose(expected, value, rel_tol=_ROUNDING, abs_tol=_ROUNDING) if numbers else expected == value


def _to_json(
    run: AttackRun, checked: Sequence[FrameCheck], totals: CheckLog, failed: dict[str, str]
) -> dict[str, Any]:
    differences: list[tuple[str, Mismatch]] = [(c.identifier, d) for c in checked for d in c.differences]
    differences += [(WHOLE_RUN, d) for d in totals.differences]
    rows = []
    for check, holds in CHECKS.items():
        own = [name for name, d in differences if d.check == check]
        rows.append(
            {
                "name": check,
                "holds": holds,
                "compared": sum(c.compared.get(check, 0) for c in (*checked, totals)),
                "differing": len(own),
                "frames_differing": list(dict.fromkeys(own)),
            }
        )
    pictures = {name for c in checked for name in c.levels}
    return {
        "run": str(run.folder),
        "detector": run.detector,
        "params": run.params,
        "frames": len(checked),
        "frames_of_run": len(run.frames),
        "agree": not differences and not failed,
        "checks": rows,
        "rendered_again": {
            name: {
                "largest_level": max(c.levels[name].largest for c in checked),
                "largest_share": max(c.levels[name].share for c in checked),
            }
            for name in sorted(pictures)
        },
        "tolerances": {"levels": LEVELS, "box_px": BOX_PX, "score": SCORE, "label": LABEL, "draws": DRAWS},
        "differences": [{"frame": name, **asdict(d)} for name, d in differences],
        "frames_ungraded": sum(not frame.result.graded for frame in run.frames),
        "frames_failed": failed,
    }
