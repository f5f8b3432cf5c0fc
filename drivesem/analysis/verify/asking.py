"""A finished run against its own files, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from drivesem.analysis.verify.differences import CHECKS, CheckLog, Disagreement
from drivesem.analysis.verify.frame import BOX_PX, DRAWS, LABEL, LEVELS, SCORE, Checked, Given, check_frame
from drivesem.attack.aims import Aim
from drivesem.attack.budgets import budget_of
from drivesem.attack.judging import t_star_of
from drivesem.config.commands import Attack, Verify
from drivesem.config.errors import UsageError
from drivesem.run.ask import Bar, ask
from drivesem.run.attack import grader_of, params_of, summary_of
from drivesem.run.finished import MANIFEST, METRICS, Run, load_runs
from drivesem.run.folder import CONFIG, FRAMES, detector_of, settings_of, trusted_attack
from drivesem.run.manifest import OF_RUN, digest_of, field_hashes
from drivesem.run.records import from_json
from drivesem.run.results import SCHEMA
from scene_ir import files
from scene_ir.errors import FormatError

WHOLE_RUN = "(run)"
"""Stands for a frame's name where a difference is the run's."""
_NOT_COMPUTED = ("schema", "out", "seconds", "frames_without_vehicles", "frames_failed")
"""Of metrics.json: what does not follow from the frames. The last two are in its hash."""
_ROUNDING = 1e-9


def verify_run(config: Verify) -> tuple[dict[str, Any], Path]:
    """Check a run's frames: the JSON's form, and the file that holds it. Raises UsageError or SceneError for bad
    input.
    """
    (run,) = load_runs([config.run or ""])
    build = partial(VerifyWorker, config, run)
    worker = build()
    out = Path(config.out) if config.out else run.folder / "verify.json"
    if out.is_dir():
        raise UsageError("--out", "a file", f"the folder {out}")
    names = [frame.result.identifier for frame in run.frames][: config.limit]
    answers = ask(names, worker, build, config, Bar("checking frames", stays=False))
    checked = [answers.results[name] for name in names if name in answers.results]
    data = _data(run, checked, worker.given.sealed, _totals(run, worker), answers.failed)
    files.write_json(out, data)
    return data, out


class VerifyWorker:
    """What one process needs: built once, used for many frames."""

    def __init__(self, config: Verify, run: Run) -> None:
        attack = trusted_attack(run.folder, config.trust)
        detector = detector_of(attack, config.device)
        self.run, self.attack = run, attack
        self.manifest = Manifest.read(run.folder / MANIFEST)
        self.given = Given(
            detector=detector,
            device=config.device,
            backend=attack.backend,
            params=params_of(attack),
            budget=budget_of(attack.budget),
            parametrisation=attack.parametrisation,
            aim=Aim.of(attack.target_objects, attack.target_classes),
            t_star=t_star_of(detector, attack.t_star),
            hashes=self.manifest.frames,
            field_hashes=self.manifest.frame_fields,
            sealed=self.manifest.settings is not None,
            grader=grader_of(replace(attack, confirm=False), detector),
        )

    def __call__(self, name: str) -> Checked:
        """One frame of the run."""
        return check_frame(name, self.run.folder / FRAMES / name, self.given)


@dataclass(frozen=True, slots=True)
class Manifest:
    """What manifest.json says. settings, metrics: those of the run and the digest of its figures, None in runs of
    earlier versions, which hashed pictures, labels and theta.json alone; frames: hashes by frame and file;
    run_fields, frame_fields: of single values of metrics.json and, by frame, of result.json, none in earlier runs.
    """

    settings: Mapping[str, Any] | None
    metrics: str | None
    frames: Mapping[str, Mapping[str, str]]
    run_fields: Mapping[str, str]
    frame_fields: Mapping[str, Mapping[str, str]]

    @classmethod
    def read(cls, path: Path) -> Manifest:
        """Raises FormatError where the file is damaged."""
        data = files.read_json(path)
        frames, settings = data.get("frames"), data.get("settings")
        if not isinstance(frames, dict) or not all(isinstance(part, dict) for part in frames.values()):
            raise FormatError(f"{path}: frames", "hashes by frame and file", "something else")
        if not isinstance(settings, dict | None):
            raise FormatError(f"{path}: settings", "settings by name", type(settings).__name__)
        fields = from_json(_Fields, data.get("fields", {}), f"{path}: fields")
        return cls(settings, data.get("metrics"), frames, fields.run, fields.frames)


@dataclass(frozen=True, slots=True)
class _Fields:
    run: dict[str, str] = field(default_factory=dict)
    frames: dict[str, dict[str, str]] = field(default_factory=dict)


def _totals(run: Run, worker: VerifyWorker) -> CheckLog:
    """config.yaml, and metrics.json against what all frames of the run hold."""
    log, metrics, manifest = CheckLog(), files.read_json(run.folder / METRICS), worker.manifest
    if manifest.settings is not None:
        log.same("files", METRICS, manifest.metrics, digest_of(metrics))
        log.each("files", METRICS, manifest.run_fields, field_hashes(metrics, OF_RUN))
        now = settings_of(worker.attack)
        # A setting that came with a later version had its default before.
        before = settings_of(Attack()) | dict(manifest.settings)
        for name in sorted(now.keys() | before.keys()):
            log.same("settings", f"{CONFIG}: {name}", now.get(name), before.get(name))
    results = [frame.result for frame in run.frames]
    figures = summary_of(worker.attack, worker.given.params, worker.given.detector, results).to_json()
    for name in _NOT_COMPUTED:
        del figures[name]
    told = dict(_leaves("", metrics))
    for name, found in _leaves("", figures):
        if name in told or metrics.get("schema") == SCHEMA:
            log.told("totals", f"{METRICS}: {name}", told.get(name), found, agrees=_equal(told.get(name), found))
    return log


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """What an object holds, by the path to it."""
    if isinstance(value, dict) and value:
        for key, part in value.items():
            yield from _leaves(f"{name}.{key}" if name else key, part)
    else:
        yield name, value


def _equal(told: Any, found: Any) -> bool:
    """Whether a figure is what was found; floating-point numbers up to how a processor rounds."""
    numbers = isinstance(told, int | float) and isinstance(found, float)
    return math.isclose(told, found, rel_tol=_ROUNDING, abs_tol=_ROUNDING) if numbers else told == found


def _data(
    run: Run, checked: Sequence[Checked], sealed: bool, totals: CheckLog, failed: dict[str, str]
) -> dict[str, Any]:
    """JSON's form."""
    differences: list[tuple[str, Disagreement]] = [(c.identifier, d) for c in checked for d in c.differences]
    differences += [(WHOLE_RUN, d) for d in totals.differences]
    rows = []
    for check, holds in CHECKS.items():
        ours = [(name, d) for name, d in differences if d.check == check]
        compared = sum(c.compared.get(check, 0) for c in checked) + totals.compared.get(check, 0)
        rows.append(
            {
                "name": check,
                "holds": holds,
                "compared": compared,
                "differing": len(ours),
                "frames_differing": list(dict.fromkeys(name for name, _ in ours)),
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
        "sealed": sealed,
        "frames_ungraded": sum(not frame.result.graded for frame in run.frames),
        "frames_failed": failed,
    }
