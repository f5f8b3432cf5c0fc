"""`drivesem attack`: every frame through the pipeline, then the figures and the page."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor

from detectors.base import Detector, DetectorError, Predictor
from detectors.registry import load_detector, load_predictor
from drivesem.attack.aims import Aim
from drivesem.attack.budgets import budget_of, written
from drivesem.attack.changes import Changes, parse_changes, vehicle_mesh
from drivesem.attack.judging import HEADLINE, JudgedClasses, t_star_of
from drivesem.attack.methods.apgd import APGD
from drivesem.attack.methods.base import GRADIENT_PASSES, LOOKED_AT
from drivesem.attack.methods.base import Attack as AttackMethod
from drivesem.attack.methods.climb import Climb
from drivesem.attack.methods.cma_es import CMAES
from drivesem.attack.methods.corners import Corners
from drivesem.attack.methods.fgsm import FGSM
from drivesem.attack.methods.placebo import Placebo
from drivesem.attack.methods.restarts import Restarted
from drivesem.attack.methods.sampling import Sampling
from drivesem.attack.methods.scouted import Scouted
from drivesem.attack.methods.scw import SCW
from drivesem.attack.methods.sgd import SGD
from drivesem.attack.methods.si_fgsm import SiFGSM
from drivesem.attack.methods.subsets import Subsets
from drivesem.attack.objective import OF_DETECTIONS
from drivesem.attack.space import SIX, Parameter, combo, parse_params
from drivesem.config.blocks import FrameCommand, option
from drivesem.config.commands import DEFAULT_COMBO, DEFAULT_QUERIES, GRADIENT_FREE, Attack
from drivesem.config.devices import check_device
from drivesem.config.errors import UsageError
from drivesem.config.values import part_of
from drivesem.failures.certificate import Rule
from drivesem.failures.grading import Grader, witness_of
from drivesem.failures.nuisances import Nuisances
from drivesem.failures.second_renderer.choose import SecondRenderers
from drivesem.report.tables import number_of
from drivesem.run.ask import Bar, ask
from drivesem.run.finished import MANIFEST, METRICS
from drivesem.run.folder import FRAMES, claim, settings_of
from drivesem.run.frame import RESULT, AttackedScene, FrameSettings, attack_scene, write_frame
from drivesem.run.manifest import manifest_of
from drivesem.run.page import write_run
from drivesem.run.results import FrameResult, RunSummary, load_frame
from drivesem.run.tally import tally
from drivesem.scenes.sources import NoVehicleError, SceneSource, make_ready, open_source
from scene_ir import files
from scene_ir.errors import RangeError, SceneError, ShapeError
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import SceneIR

PEERS = ("yolov3-slim", "squeezedet")
"""Shipped detectors of different architectures: what is confirmed of one is shown to another."""
WITHOUT_GRADIENT = "climb"
"""The method for detectors that have no gradient, where nobody asked for one: of those that need none, it finds
most failures that hold."""
_NEED_NO_GRADIENT = (*GRADIENT_FREE, "corners", WITHOUT_GRADIENT)
"""All methods for such detectors."""
_AROUND = 3
"""Passes of a frame in which no method has a say."""
WRITTEN = (METRICS, MANIFEST, "report.html", FRAMES)


def attack_run(config: Attack) -> RunSummary:
    """Run or continue an attack in the folder that the settings name, or in one under `runs`. Raises UsageError or
    SceneError for bad input.
    """
    start = time.perf_counter()
    _check_texts(config)
    config = _settled(config)
    aim_of(config)
    check_device(config.device)
    detector = named_detector(config)
    suited = suited_to(config, detector)
    worker = Worker.of(suited, detector)
    if suited.method != config.method:
        told = f"--method {suited.method} takes the place of {config.method}"
        sys.stderr.write(f"{config.detector} has no gradient: {told}\n")
    config = suited
    out = Path(config.out) if config.out else Path("runs") / _name(config, worker.params)
    claim(out, config, WRITTEN)
    names, without, failed = select_frames(worker.source, config)
    _check_any(config, names, without, failed)
    return _attacked(worker, (_of_part(names, config.part), without, failed), out, start, must_find=True)


def attack_frames(worker: Worker, names: Sequence[str], out: Path) -> RunSummary:
    """Attack these frames, of all that the worker's source has, into the run folder `out`; those that are there
    already stay. Raises as `run`.
    """
    start = time.perf_counter()
    claim(out, worker.config, WRITTEN)
    return _attacked(worker, (list(names), 0, {}), out, start)


def _attacked(
    worker: Worker,
    selected: tuple[list[str], int, dict[str, str]],
    out: Path,
    start: float,
    must_find: bool = False,
) -> RunSummary:
    """Attack what `select_frames` chose, as far as it is not done, and write what is said of all frames.

    must_find: raise UsageError where the detector finds nothing in any photograph.
    """
    names, without_vehicles, failed = selected
    config = worker.config
    todo = [name for name in names if not (out / FRAMES / name / RESULT).is_file()]
    if todo and config.backend == "warp" and config.device == "cpu":
        make_ready(config)
    work, build = partial(worker.attack, out=out), partial(_attacker, config, out)
    answers = ask(todo, work, build, config, Bar("attacking frames", remaining=True))
    failed = failed | answers.failed
    empty = {name for name, usable in answers.results.items() if not usable}
    done = [name for name in names if name not in failed and name not in empty]
    if names and not done and config.part is None:
        _check_any(config, done, without_vehicles + len(empty), failed)
    results = [load_frame(out / FRAMES / name / RESULT) for name in done]
    if must_find:
        _check_sight(worker, results)
    summary = replace(
        summary_of(config, worker.params, worker.detector, results),
        frames_without_vehicles=without_vehicles + len(empty),
        frames_failed=dict(sorted(failed.items())),
        seconds=round(time.perf_counter() - start, 3),
    )
    return conclude(out, config, summary, results, empty)


def _check_texts(config: Attack) -> None:
    """FormatError for a setting that no file of the run could hold: the first is written after all frames."""
    for name, value in settings_of(config, presentation=()).items():
        if isinstance(value, str):
            files.check_text(option(name), value)


def _check_any(config: Attack, names: Sequence[str], without: int, failed: Mapping[str, str]) -> None:
    """UsageError where no frame can be attacked: figures of none would say nothing."""
    if names:
        return
    found = [f"{number_of(without, 'frame')} without"] if without else []
    if failed:
        found.append(f"{len(failed)} that cannot be used, such as {next(iter(failed.items()))[1]}")
    expected = "frames with cars, vans or trucks to attack (drivesem derender --sheet draws what it makes of one)"
    raise UsageError(
        f"--root {config.root}" if config.root else "--dataset", expected, "; ".join(found) or "no frame"
    )


def conclude(
    out: Path, config: Attack, summary: RunSummary, results: Sequence[FrameResult], empty: Collection[str]
) -> RunSummary:
    """Write into the folder of a run what is said of all of its frames. empty: those that have vehicles, of which
    none could be taken apart.
    """
    summary = replace(summary, out=str(out))
    metrics = summary.to_json()
    files.write_json(out / METRICS, metrics)
    names = [result.identifier for result in results]
    manifest = manifest_of(config, out, names, metrics) | {"empty": sorted(empty)}
    files.write_json(out / MANIFEST, manifest)
    write_run(out, config, summary, results)
    return summary


def _check_sight(worker: Worker, results: Sequence[FrameResult]) -> None:
    """UsageError for a detector that finds nothing in any photograph: it has nothing to lose, and figures of an
    attack on it would say nothing. One frame in which nothing is found is no reason.
    """
    t_star = t_star_of(worker.detector, worker.config.t_star)
    scores = [box.score or 0 for result in results for box in result.detections_benign]
    if len(results) > 1 and max(scores, default=0) < t_star:
        best = f"the best score is {max(scores):.3g}" if scores else "no detection at all"
        found = f"{best} in {len(results)} photographs (is its input prepared as in training? drivesem eval)"
        raise UsageError("--detector", f"one that finds something, with a score of {t_star:.3g} or more", found)


def params_of(config: Attack) -> tuple[Parameter, ...]:
    """What is to move. Raises FormatError where the budget holds it."""
    params = _named_params(config)
    budget_of(config.budget).check(params, config.parametrisation)
    return params


def _named_params(config: Attack) -> tuple[Parameter, ...]:
    if config.params is not None:
        return parse_params(config.params)
    if config.method == "subsets" and config.combo is None:
        return SIX
    return combo(config.combo or DEFAULT_COMBO)


def _settled(config: Attack) -> Attack:
    """The configuration with the budget's numbers in place of its file, so that a run can be repeated without."""
    return replace(config, budget=written(budget_of(config.budget)))


@dataclass(frozen=True)
class Worker:
    """What one process needs: built once, used for many frames."""

    config: Attack
    params: tuple[Parameter, ...]
    method: AttackMethod
    source: SceneSource
    detector: Predictor
    grader: Grader
    changes: Changes | None = None

    @classmethod
    def of(cls, config: Attack, detector: Predictor | None = None) -> Worker:
        """detector: by default the one that the settings name. Raises UsageError for a detector that cannot be
        used, SceneError for a source that cannot be read.
        """
        config = _settled(config)
        params, source, method = params_of(config), open_source(config), attack_method(config)
        detector = named_detector(config) if detector is None else detector
        _check_detector(config, detector, method.needs_gradient)
        grader, changes = grader_of(config, detector), changes_of(config)
        return cls(config, params, method, source, detector, grader, changes)

    def beside(self, config: Attack) -> Worker:
        """For another attack on the same source and detector, which are shared."""
        config = _settled(config)
        return replace(self, config=config, params=params_of(config), method=attack_method(config))

    def attack(self, identifier: str, out: Path) -> bool:
        """One frame, from the source to its folder; False where it has no vehicle to attack. The result, a quarter
        of a megabyte, is in the folder alone: a night has thousands.
        """
        try:
            self.attack_scene(identifier, self.source.scene(identifier), out)
        except NoVehicleError:
            return False
        return True

    def attack_scene(self, identifier: str, scene: SceneIR, out: Path) -> FrameResult:
        """One frame that has been taken apart, to its folder. Raises NoVehicleError where it has no vehicle."""
        return write_frame(self.search(identifier, scene), out / FRAMES / identifier)

    def search(self, identifier: str, scene: SceneIR) -> AttackedScene:
        """One frame that has been taken apart, in memory. Raises NoVehicleError where it has no vehicle."""
        if len(scene.objects) == 0:
            raise NoVehicleError(f"frame {identifier}", "a vehicle that can be taken apart", "none")
        config = self.config
        aim = aim_of(config)
        if aim.objects is not None and aim.objects[-1] >= len(scene.objects):
            count = f"{len(scene.objects)} of them"
            raise NoVehicleError(f"frame {identifier}", f"objects up to the {aim.objects[-1]}th from 0", count)
        settings = FrameSettings(
            attack=self.method if config.like is None else _placebo(Path(config.like), identifier),
            params=self.params,
            label_mode=config.objective_labels,
            term=config.objective,
            render=RenderSettings(backend=config.backend),
            seed=config.seed,
            t_star=config.t_star,
            budget=budget_of(config.budget),
            aim=aim,
            grader=self.grader if config.grade else None,
            keep_last=config.keep == "last",
            only_bounds=config.project == "bounds",
            parametrisation=config.parametrisation,
            whole=config.whole,
            keep_mb=config.keep_mb,
            changes=self.changes,
        )
        try:
            return attack_scene(identifier, scene, self.detector, settings)
        except (RangeError, ShapeError) as error:
            # A loss or gradient that is no number says where in the scene, and not in which.
            raise type(error)(f"frame {identifier}: {error.field}", error.expected, error.actual) from error


def changes_of(config: Attack) -> Changes | None:
    """What the settings let a search propose; None for nothing. Raises FormatError for what is no change, or no
    mesh of a vehicle.
    """
    if config.changes is None:
        return None
    return Changes(parse_changes(config.changes), None if config.mesh is None else vehicle_mesh(config.mesh))


def aim_of(config: Attack) -> Aim:
    """What the settings ask the attack to be after. Raises UsageError."""
    return Aim.of(config.target_objects, config.target_classes)


def attack_method(config: Attack) -> AttackMethod:
    """The algorithm that the settings ask for."""
    attack = _from_theta0(config)
    if config.restarts:
        attack = Restarted(attack, config.restarts, config.steps, config.early_stop)
    return Scouted(attack, config.scouts, early_stop=config.early_stop) if config.scouts else attack


def _from_theta0(config: Attack) -> AttackMethod:
    early_stop = config.early_stop
    steps, queries = _afforded(config)
    match config.method:
        case "si-fgsm":
            return SiFGSM(steps, early_stop, config.momentum, config.rate)
        case "apgd":
            return APGD(steps, early_stop, config.rate)
        case "fgsm":
            return FGSM(steps)
        case "sgd":
            return SGD(steps, early_stop, config.momentum, config.rate, config.step_form)
        case "scw":
            return SCW(queries, steps, config.norm, config.rate, early_stop)
        case "climb":
            return Climb(config.passes or Climb().passes)
        case "corners":
            return Corners(config.passes or Corners().passes)
        case "placebo":
            return Placebo()
        case "subsets":
            return Subsets(queries, steps)
        case "cma-es":
            return CMAES(queries, _reach(config), early_stop)
        case "random" | "halton" | "sobol":
            return Sampling(queries, _reach(config), early_stop, config.method)


def _afforded(config: Attack) -> tuple[int, int]:
    """Steps, and queries, as many as --passes allows where it is given. Beside them a frame takes a few passes:
    the photograph, its re-render, and the re-scoring of what was found. Methods that count both as queries may
    take a gradient and a render for each.
    """
    if config.passes is None:
        return config.steps, config.queries or DEFAULT_QUERIES
    if config.method in GRADIENT_FREE:
        return config.steps, max(config.passes - _AROUND, 1)
    a_step = GRADIENT_PASSES + (config.early_stop or config.method in ("scw", "subsets"))
    left = config.passes - _AROUND - config.scouts - (LOOKED_AT + 1) * (config.restarts + 1)
    afforded = max(left // (a_step * (config.restarts + 1)), 2)
    return afforded, afforded


def grader_of(config: Attack, detector: Predictor) -> Grader:
    """What grades the failures of a run with these settings. Raises UsageError for settings that cannot be."""
    return Grader(
        detector=detector,
        t_star=t_star_of(detector, config.t_star),
        nuisances=Nuisances.of(config.nuisances),
        rule=Rule(config.draws),
        seed=config.seed,
        second=SecondRenderers(config.dataset, config.root).of if config.confirm else None,
        peer=_peer(config),
        witness=None if config.witness is None else _witness(config, config.witness),
    )


def _peer(config: Attack) -> Callable[[], Predictor] | None:
    """What loads the detector of another architecture; None where nobody is to be asked."""
    if config.peer == "off" or not config.confirm:
        return None
    others = [name for name in PEERS if name != config.detector]
    name = others[0] if config.peer == "auto" else config.peer
    if config.peer == "auto":
        return cache(partial(load_predictor, name, config.device, config.tiles))
    try:
        peer = load_predictor(name, config.device, config.tiles)
        JudgedClasses.of(peer)
    except DetectorError as error:
        raise UsageError.of("--peer", "auto, off, or a detector", error) from error
    return lambda: peer


def _witness(config: Attack, name: str) -> Callable[[Tensor], Tensor]:
    try:
        return witness_of(load_predictor(name, config.device, config.tiles))
    except DetectorError as error:
        raise UsageError.of("--witness", "a detector", error) from error


def _placebo(run: Path, identifier: str) -> Placebo:
    """An edit as large as what a run did to the frame. Raises FormatError where the run has no such frame."""
    return Placebo(tuple(c.value for c in load_frame(run / FRAMES / identifier / RESULT).theta))


def _reach(config: Attack) -> int | None:
    """Steps around theta0 within which a search without gradient looks; None for all of the bounds."""
    return config.steps if config.range == "steps" else None


def named_detector(config: Attack) -> Predictor:
    """The detector under attack. Raises UsageError where it is none."""
    try:
        if config.precision == "float32":
            return load_predictor(config.detector, config.device, config.tiles)
        return load_detector(config.detector, config.device, getattr(torch, config.precision))
    except DetectorError as error:
        raise UsageError.of("--detector", "a detector", error) from error


def suited_to(config: Attack, detector: Predictor) -> Attack:
    """The settings with a method that needs no gradient, where the detector has none and nobody asked for one."""
    if isinstance(detector, Detector) or config.method != Attack().method:
        return config
    suited = replace(config, method=WITHOUT_GRADIENT)
    suited.check()
    return suited


def _check_detector(config: Attack, detector: Predictor, needs_gradient: bool) -> None:
    """Raises UsageError where the detector knows no cars, or lacks a gradient that the settings need."""
    try:
        JudgedClasses.of(detector)
    except DetectorError as error:
        raise UsageError.of("--detector", "a detector", error) from error
    if isinstance(detector, Detector):
        return
    if needs_gradient:
        expected = f"one of {', '.join(_NEED_NO_GRADIENT)} for {config.detector}, which has no gradient"
        raise UsageError("--method", expected, config.method)
    if config.objective not in OF_DETECTIONS:
        expected = f"one of {', '.join(OF_DETECTIONS)} for {config.detector}, which has no gradient"
        raise UsageError("--objective", expected, config.objective)


def _attacker(config: Attack, out: Path) -> Callable[[str], bool]:
    return partial(Worker.of(config).attack, out=out)


def select_frames(source: SceneSource, config: FrameCommand) -> tuple[list[str], int, dict[str, str]]:
    """The frames to attack, how many without vehicles were passed over, and those that cannot be read."""
    names: list[str] = []
    failed: dict[str, str] = {}
    without = 0
    for identifier in source.identifiers():
        if config.limit is not None and len(names) == config.limit:
            break
        try:
            usable = source.has_vehicles(identifier)
        except SceneError as error:
            if not config.keep_going:
                raise
            failed[identifier] = str(error)
            continue
        if usable:
            names.append(identifier)
        else:
            without += 1
    return names, without, failed


def _of_part(names: list[str], part: str | None) -> list[str]:
    """Every N-th of the frames, from the K-th on, so that all parts take about as long."""
    if part is None:
        return names
    number, count = part_of("--part", part)
    return names[number - 1 :: count]


def _name(config: Attack, params: tuple[Parameter, ...]) -> str:
    method = "" if config.method == Attack().method else f"-{config.method}"
    return f"{config.dataset}-{'-'.join(params)}{method}-seed{config.seed}"


def summary_of(
    config: Attack, params: tuple[Parameter, ...], detector: Predictor, results: Sequence[FrameResult]
) -> RunSummary:
    """The figures of a run, as far as they follow from its settings and its frames."""
    t_star = t_star_of(detector, config.t_star)
    return RunSummary(
        out="",
        dataset=config.dataset,
        params=tuple(str(p) for p in params),
        detector=config.detector,
        headline=HEADLINE,
        t_star=t_star,
        frames_without_vehicles=0,
        frames_failed={},
        seconds=0.0,
        **tally(results, JudgedClasses.of(detector), t_star, HEADLINE),
    )
