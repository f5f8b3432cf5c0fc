"""Counterexamples of a run, drawn again by a second renderer, frame by frame."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from drivesem.analysis.confirm.frame import CONFIRMED, confirm_frame
from drivesem.analysis.confirm.report import Confirmation, answer_of, summarise
from drivesem.analysis.confirm.results import Confirmed, load
from drivesem.attack.judging import JudgedClasses
from drivesem.config.blocks import DEMO
from drivesem.config.commands import Confirm
from drivesem.config.errors import UsageError
from drivesem.config.values import is_url
from drivesem.failures.second_renderer.choose import SecondRenderers
from drivesem.report.answer import Answer
from drivesem.run.ask import Bar, KeptFrames
from drivesem.run.finished import METRICS, Run, load_runs
from drivesem.run.folder import FRAMES, PRESENTATION, claim, detector_of, trusted_attack
from scene_ir import files

_WRITTEN = ("confirm.json", "confirm.md", "confirm.csv", FRAMES)


def confirm_run(config: Confirm) -> tuple[Confirmation, Answer]:
    """Confirm a run's frames, or go on with it, and write what is said of them: the figures, and all of it. Raises
    UsageError or SceneError for bad input, NoSecondRendererError before anything is written.
    """
    (run,) = load_runs([config.run or ""], config.limit)
    out = Path(config.out) if config.out else run.folder / "confirm"
    build = partial(ConfirmWorker, config, run, out)
    worker = build()
    # Frames are kept by the result they belong to, so that another name of the run's folder is not in the way.
    claim(out, config, _WRITTEN, (*PRESENTATION, "run", "root", "seed"))
    frames = KeptFrames(run.folder, out, CONFIRMED, load)
    names = [frame.result.identifier for frame in run.frames]
    confirmed, failed = frames.ask(names, worker, build, config, Bar("drawing frames again", stays=False))
    if not confirmed:
        raise UsageError("--run", "a run with frames that can be used", run.folder)
    results = [frame.result for frame in run.frames if frame.result.identifier not in failed]
    report = summarise(confirmed, results, JudgedClasses.of(worker.detector).names, worker.t_star)
    facts = {
        "run": str(run.folder),
        "detector": run.detector,
        "params": run.params,
        "t_star": worker.t_star,
    }
    answer = answer_of(out, report, confirmed, facts, failed)
    answer.write()
    return report, answer


class ConfirmWorker:
    """What one process needs: built once, used for many frames."""

    def __init__(self, config: Confirm, run: Run, out: Path) -> None:
        attack = trusted_attack(run.folder, config.trust)
        self.run, self.out = run, out
        self.frames = {frame.result.identifier: frame for frame in run.frames}
        if attack.dataset == DEMO and config.root is not None:
            raise UsageError("--root", "none for the embedded scenes", config.root)
        if config.root is None and is_url(attack.root or ""):  # a run does not say where this machine looks
            raise UsageError("--root", "the run's data set, named again as it lies elsewhere", attack.root)
        self.second = SecondRenderers(attack.dataset, config.root or attack.root)
        self.second.check()
        self.detector = detector_of(attack, config.device)
        self.device, self.t_star = config.device, float(files.read_json(run.folder / METRICS)["t_star"])

    def __call__(self, name: str) -> Confirmed:
        """One frame of the run, into its folder."""
        source, folder = self.run.folder / FRAMES / name, self.out / FRAMES / name
        frame = self.frames[name]
        return confirm_frame(frame, source, self.second, self.detector, self.device, self.t_star, folder)
