"""The counterexamples of a finished run explained, frame by frame."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from drivesem.analysis.explain.frame import Effort, explain_frame
from drivesem.analysis.explain.report import answer_of, exchange_note, means
from drivesem.analysis.explain.results import EXPLANATION, read_explanation
from drivesem.attack.space import Parameter, parse_params
from drivesem.config.commands import Attack, Explain
from drivesem.config.errors import UsageError
from drivesem.evaluation.resampling import DRAWS
from drivesem.report.answer import Answer
from drivesem.report.tables import number_of
from drivesem.run.ask import Bar, KeptFrames
from drivesem.run.finished import Run, load_runs
from drivesem.run.folder import FRAMES, PRESENTATION, claim, detector_of, trusted_attack

_WRITTEN = ("explain.json", "explain.md", "explain.csv", "explain.png", FRAMES)
_FREE = (*PRESENTATION, "run", "frame", "bootstrap")
"""Settings that a second call may change: none is in a frame's explanation."""


def explain_run(config: Explain) -> Answer:
    """Explain a run's frames, or go on with it, and write what is said of them. Raises UsageError or SceneError
    for bad input.
    """
    (run,) = load_runs([config.run or ""])
    names = _chosen(run, config)
    out = Path(config.out) if config.out else run.folder / "explain"
    build = partial(ExplainWorker, config, trusted_attack(run.folder, config.trust), parse_params(run.params), out)
    work = build()
    claim(out, config, _WRITTEN, _FREE)
    frames = KeptFrames(run.folder, out, EXPLANATION, read_explanation)
    kept, failed = frames.ask(names, work, build, config, Bar("explaining frames"))
    explanations = [one for one in kept if not one.by_exchange]
    by_exchange = [one.identifier for one in kept if one.by_exchange]
    if not explanations:
        found = "; ".join([*failed.values(), *([exchange_note(by_exchange)] if by_exchange else [])])
        raise UsageError("--run", "a run with frames that can be explained", found)
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    facts = {
        "out": str(out),
        "run": str(run.folder),
        "detector": run.detector,
        "params": run.params,
        "frames": len(explanations),
        "frames_of_run": len(run.frames),
        "frames_failed": failed,
        "frames_by_exchange": by_exchange,
        "bootstrap": draws,
    }
    answer = answer_of(out, explanations, means(explanations, draws, config.seed), draws, facts)
    answer.write()
    return answer


class ExplainWorker:
    """What one process needs: built once, used for many frames."""

    def __init__(self, config: Explain, attack: Attack, params: tuple[Parameter, ...], out: Path) -> None:
        self.config, self.params, self.out = config, params, out
        whole = config.whole_beside(attack.whole)
        self.attack = replace(attack, whole=whole, incremental=False, keep_mb=config.keep_mb)
        self.detector = detector_of(attack, config.device)

    def __call__(self, name: str) -> None:
        """One frame, from the run's folder to its own."""
        config = self.config
        folder = Path(config.run or "") / FRAMES / name
        effort = Effort(config.points, config.permutations, config.seed, lost=config.least == "lost")
        explain_frame(folder, self.attack, self.params, self.detector, effort, self.out / FRAMES / name)


def _chosen(run: Run, config: Explain) -> list[str]:
    """The frames to explain: those that fail by moved labels. Raises UsageError where there is none."""
    fails = {frame.result.identifier: frame.result.success_moved for frame in run.frames}
    asked = [part.strip() for part in (config.frame or "").split(",") if part.strip()]
    for name in asked:
        if name not in fails:
            raise UsageError("--frame", f"a frame of {run.folder}", name)
        if not fails[name]:
            raise UsageError("--frame", "frames that fail, by moved labels", f"{name}, which does not")
    names = [name for name in fails if fails[name] and (not asked or name in asked)]
    if not names:
        raise UsageError(
            "--run", "a run with counterexamples, by moved labels", f"none in {number_of(len(fails), 'frame')}"
        )
    return names[: config.limit]
