"""A finished run against its own files, frame by frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from drivesem.attack.aims import Aim
from drivesem.attack.budgets import budget_of
from drivesem.attack.judging import t_star_of
from drivesem.attack.space import parse_params
from drivesem.questions.verify.differences import CHECKS, CheckLog, Disagreement
from drivesem.questions.verify.frame import BOX_PX, DRAWS, LABEL, LEVELS, SCORE, Checked, Given, check_frame
from drivesem.run.ask import Bar, ask
from drivesem.run.attack import grader_of
from drivesem.run.finished import MANIFEST, METRICS, Run, load_runs
from drivesem.run.folder import FRAMES, attack_of, detector_of
from drivesem.run.results import FrameResult
from drivesem.run.tally import graded
from drivesem.settings.commands import Verify
from drivesem.settings.errors import UsageError
from scene_ir import files
from scene_ir.errors import FormatError

_WHOLE_RUN = "(run)"
"""Stands for a frame's name where a difference is the run's."""


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
    data = _data(run, checked, _totals(run, worker.given.t_star), answers.failed)
    files.write_json(out, data)
    return data, out


class VerifyWorker:
    """What one process needs: built once, used for many frames."""

    def __init__(self, config: Verify, run: Run) -> None:
        attack = attack_of(run.folder)
        detector = detector_of(attack, config.device)
        self.run = run
        self.given = Given(
            detector=detector,
            device=config.device,
            backend=attack.backend,
            params=parse_params(run.params),
            budget=budget_of(attack.budget),
            aim=Aim.of(attack.target_objects, attack.target_classes),
            t_star=t_star_of(detector, attack.t_star),
            hashes=_hashes(run),
            grader=grader_of(replace(attack, confirm=False), detector),
        )

    def __call__(self, name: str) -> Checked:
        """One frame of the run."""
        return check_frame(name, self.run.folder / FRAMES / name, self.given)


def _hashes(run: Run) -> Mapping[str, Mapping[str, str]]:
    frames = files.read_json(run.folder / MANIFEST)["frames"]
    if not isinstance(frames, dict) or not all(isinstance(part, dict) for part in frames.values()):
        raise FormatError(f"{run.folder / MANIFEST}: frames", "hashes by frame and file", "something else")
    return frames


def _totals(run: Run, t_star: float) -> CheckLog:
    """metrics.json against what all frames of the run hold."""
    results = [frame.result for frame in run.frames]
    log, metrics = CheckLog(), files.read_json(run.folder / METRICS)
    grades = graded(results) if "grades" in metrics else {}
    for name, found in {**_added_up(results), **grades, "t_star": t_star}.items():
        log.same("totals", f"{METRICS}: {name}", metrics.get(name), found)
    return log


def _added_up(results: Sequence[FrameResult]) -> dict[str, Any]:
    failures = [failure.kind for result in results for failure in result.failures]
    return {
        "frames": len(results),
        "objects": sum(result.objects for result in results),
        "lost_objects": failures.count("lost"),
        "phantoms": failures.count("phantom"),
        "successes_paper": sum(result.success_paper for result in results),
        "successes_moved": sum(result.success_moved for result in results),
        "feasible_fraction": sum(result.feasible for result in results) / len(results),
        "queries": sum(result.queries for result in results),
    }


def _data(run: Run, checked: Sequence[Checked], totals: CheckLog, failed: dict[str, str]) -> dict[str, Any]:
    """JSON's form."""
    differences: list[tuple[str, Disagreement]] = [(c.identifier, d) for c in checked for d in c.differences]
    differences += [(_WHOLE_RUN, d) for d in totals.differences]
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
        "frames_ungraded": sum(not frame.result.graded for frame in run.frames),
        "frames_failed": failed,
    }
