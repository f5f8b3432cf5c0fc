"""Attacks on frames: one process, one scene, a whole run with its report, and parts merged into one run."""

from __future__ import annotations

import os
import shutil
import sys
import time
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from detectors.base import Detector, DetectorError, Predictor, detector_device, explain_missing_gradient
from detectors.check import survey_streets
from detectors.registry import load_detector, load_predictor
from drivesem.attacks.budgets import format_budget, parse_budget, resolve_parameters
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.methods.base import GRADIENT_PASSES, MAX_RESCORED, Attack, AttackResult, Problem
from drivesem.attacks.methods.gradient_ascent import APGD, FGSM, SGD, SiFGSM
from drivesem.attacks.methods.gradient_free import CMAES, FixedTheta, Placebo, Sampling
from drivesem.attacks.methods.learned import Learn
from drivesem.attacks.methods.margin_search import (
    FIRST_HELD_OUT_SAMPLE,
    Climb,
    Corners,
    MarginSearch,
    margin_objective,
)
from drivesem.attacks.methods.scw import SCW
from drivesem.attacks.objective import GRADIENT_FREE_TERMS, Objective
from drivesem.attacks.space import Parameter, parse_params
from drivesem.attacks.targets import HEADLINE, EvaluatedClasses, TargetSelection, resolve_t_star
from drivesem.config.commands import DEFAULT_QUERIES, GRADIENT_FREE_METHODS, AttackConfig
from drivesem.config.constraints import parse_part
from drivesem.config.devices import check_device
from drivesem.config.errors import UsageError
from drivesem.config.options import FrameCommandConfig, option_name
from drivesem.data.account import write_account_of
from drivesem.failures.certificate import CertificateRule
from drivesem.failures.grading import Grader, make_reference_detector
from drivesem.failures.margin_oracle import NuisanceMarginOracle
from drivesem.failures.nuisances import Nuisances
from drivesem.reporting.tables import format_count
from drivesem.run.allocation import release_freed_memory
from drivesem.run.driver import JobResults, ProgressSettings, run_frame_jobs
from drivesem.run.finished import MANIFEST, METRICS, AttackRun, build_manifest, hash_json, load_runs
from drivesem.run.folder import FRAMES, PLAN, claim_folder, load_run_detector, load_trusted_config, result_settings
from drivesem.run.frame import AttackedScene, estimate_rates, grade_failures, summarise_frames, write_frame
from drivesem.run.labels import RESULT
from drivesem.run.records import from_json
from drivesem.run.results import FrameResult, RunSummary, load_frame
from drivesem.run.run_report import write_run_report
from drivesem.run.search_memory import SearchMemory
from drivesem.scenes.sources import NoVehicleError, SceneSource, compile_source_kernels, open_source
from scene_ir import files
from scene_ir.errors import FormatError, RangeError, SceneError, ShapeError
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import SceneIR, convert_scene

if TYPE_CHECKING:
    from drivesem.attacks.changes import VehicleChangeSettings
    from drivesem.failures.second_renderer.base import SecondRenderer
    from drivesem.failures.second_renderer.selection import SecondRenderers

SECOND_DETECTORS = ("yolov3-slim", "squeezedet")
"""Shipped detectors of different architectures; the one not under attack re-tests confirmed failures."""
GRADIENT_FREE_FALLBACK = "climb"
"""Default method for detectors without a gradient: of methods without one, it finds most certain failures."""
_METHODS_WITHOUT_GRADIENT = (*GRADIENT_FREE_METHODS, "corners", GRADIENT_FREE_FALLBACK, "learn")
SURVEYED_FRAMES = 8
"""Photographs of which one must have a car that the detector finds."""
_FIXED_PASSES = 3
"""Detector passes of a frame that no method controls."""
WRITTEN = (PLAN, METRICS, MANIFEST, "report.html", FRAMES)


def attack_dataset(config: AttackConfig) -> RunSummary:
    """Run or continue an attack in its folder, by default one in `runs`. Raises UsageError or SceneError for bad
    input.
    """
    start = time.perf_counter()
    _check_texts(config)
    config = _resolve_budget(config)
    TargetSelection.from_options(config.target_objects, config.target_classes)
    check_device(config.device)
    detector = load_named_detector(config)
    usable_config = with_gradient_free_fallback(config, detector)
    worker = AttackWorker.from_config(usable_config, detector)
    report_fallback(config, usable_config, detector)
    config = usable_config
    out = Path(config.out) if config.out else Path("runs") / _run_name(config, worker.params)
    claim_folder(out, config, WRITTEN)
    account = write_account_of(worker.source, config.keep_going)
    own_mesh = None if worker.changes is None else worker.changes.mesh
    sys.stderr.writelines(f"--mesh: {note}\n" for note in (own_mesh.notes if own_mesh else ()))
    names, without_vehicles, failed = select_frames(worker.source, config)
    _check_any_frame(config, names, without_vehicles, failed)
    names = _select_part(names, config.part)
    _check_detections(worker, names)
    jobs = run_frame_jobs(*_prepare_jobs(worker, names, out))
    return _finish_run(worker, names, out, jobs, start, without_vehicles, failed, account)


def attack_frames(worker: AttackWorker, names: Sequence[str], out: Path) -> RunSummary:
    """Attack frames into a run folder; finished frames stay. Raises as `attack_dataset`.

    Args:
        worker: has the frames in its source.
        names: the frames.
        out: the run folder.
    """
    start = time.perf_counter()
    claim_folder(out, worker.config, WRITTEN)
    jobs = run_frame_jobs(*_prepare_jobs(worker, names, out))
    return _finish_run(worker, names, out, jobs, start)


def _prepare_jobs(worker: AttackWorker, names: Sequence[str], out: Path) -> tuple[Any, ...]:
    """The arguments of `run_frame_jobs`, for frames that are not finished."""
    config = worker.config
    files.write_json(out / PLAN, {"frames": len(names)})
    pending = [name for name in names if not (out / FRAMES / name / RESULT).is_file()]
    if pending and config.backend == "warp" and config.device == "cpu":
        compile_source_kernels(config)
    progress = ProgressSettings("attacking frames", show_remaining=True)
    return (
        pending,
        partial(worker.attack_frame, out=out),
        partial(_make_frame_attack, config, out),
        config,
        progress,
    )


def _make_frame_attack(config: AttackConfig, out: Path) -> Callable[[str], bool]:
    return partial(AttackWorker.from_config(config).attack_frame, out=out)


def _finish_run(
    worker: AttackWorker,
    names: Sequence[str],
    out: Path,
    jobs: JobResults[str, bool],
    start: float,
    without_vehicles: int = 0,
    failed: Mapping[str, str] | None = None,
    account: Mapping[str, Any] | None = None,
) -> RunSummary:
    """Summarise the frames of a run and write its files.

    Args:
        worker: attacked the frames.
        names: the frames of the run.
        out: the run folder.
        jobs: outcomes by frame; False where no vehicle could be attacked.
        start: time.perf_counter() at the start of the run.
        without_vehicles: number of frames that were passed over.
        failed: frames that could not be read, with the reason.
        account: files and label rows of the data set, as JSON.
    """
    config, failed = worker.config, {**(failed or {}), **jobs.failed}
    empty = {name for name, attacked in jobs.results.items() if not attacked}
    done = [name for name in names if name not in failed and name not in empty]
    if names and config.part is None:
        _check_any_frame(config, done, without_vehicles + len(empty), failed)
    results = [load_frame(out / FRAMES / name / RESULT) for name in done]
    summary = replace(
        summarise_run(config, worker.params, worker.detector, results),
        frames_without_vehicles=without_vehicles + len(empty),
        frames_failed=dict(sorted(failed.items())),
        seconds=round(time.perf_counter() - start, 3),
        data=account or {},
    )
    return write_run_summary(out, config, summary, results, empty)


def _check_texts(config: AttackConfig) -> None:
    """Raise FormatError for a setting that cannot be written; the run's settings are written after all frames."""
    for name, value in result_settings(config, presentation=()).items():
        if isinstance(value, str):
            files.check_utf8(option_name(name), value)


def _check_any_frame(
    config: AttackConfig, names: Sequence[str], without_vehicles: int, failed: Mapping[str, str]
) -> None:
    """Raise UsageError where no frame can be attacked."""
    if names:
        return
    reasons = [f"{format_count(without_vehicles, 'frame')} without"] if without_vehicles else []
    if failed:
        reasons.append(f"{len(failed)} that cannot be used, such as {next(iter(failed.items()))[1]}")
    kinds = "cars, vans, trucks or people" if config.moves_people else "cars, vans or trucks"
    expected = f"frames with {kinds} to attack (drivesem derender --sheet draws what it makes of one)"
    source = f"--root {config.root}" if config.root else "--dataset"
    raise UsageError(source, expected, "; ".join(reasons) or "no frame")


def write_run_summary(
    out: Path, config: AttackConfig, summary: RunSummary, results: Sequence[FrameResult], empty: Collection[str]
) -> RunSummary:
    """Write a run's metrics, manifest and report.

    Args:
        out: the run folder.
        config: the settings.
        summary: the run's metrics.
        results: of all frames.
        empty: frames with vehicles, none of which could be de-rendered.

    Returns:
        The summary with its folder.
    """
    summary = replace(summary, out=str(out))
    metrics = summary.to_json()
    files.write_json(out / METRICS, metrics)
    names = [result.identifier for result in results]
    manifest = build_manifest(config, out, names, metrics) | {"empty": sorted(empty)}
    files.write_json(out / MANIFEST, manifest)
    write_run_report(out, config, summary, results)
    return summary


def _check_detections(worker: AttackWorker, names: Sequence[str]) -> None:
    """Raise UsageError for a detector that finds no object in the first photographs: it has nothing to lose."""
    config = worker.config
    known = EvaluatedClasses.from_detector(worker.detector).names
    classes = known if config.moves_people else (HEADLINE,)
    t_star = resolve_t_star(worker.detector, config.t_star)
    if len(names) < 2:
        return

    def photographs() -> Iterator[Tensor]:
        for name in names[:SURVEYED_FRAMES]:
            try:
                yield worker.source.photograph(name).to(config.device)
            except SceneError:  # the attack of the frame reports it
                continue

    survey, _ = survey_streets(worker.detector, photographs(), t_star, until_found=True, classes=classes)
    if survey.pictures and survey.problem is not None:
        found = f"{survey.problem} (drivesem check --detector {config.detector})"
        raise UsageError(
            "--detector", f"one that finds {' or '.join(f'{name.lower()}s' for name in classes)}", found
        )


def _resolve_budget(config: AttackConfig) -> AttackConfig:
    """The settings with the budget's numbers instead of its file, so that a run can be repeated without it."""
    return replace(config, budget=format_budget(parse_budget(config.budget)))


@dataclass(frozen=True, slots=True)
class AttackInstance:
    """One scene as a problem for an attack."""

    margin_oracle: NuisanceMarginOracle
    """Margins of the scene's objects; holds the objective."""
    feasible: FeasibleSet
    """The feasible set of theta."""
    problem: Problem
    """What the attack sees."""

    @classmethod
    def from_scene(
        cls, identifier: str, scene: SceneIR, detector: Predictor, config: AttackConfig, nuisances: Nuisances
    ) -> AttackInstance:
        """The problem that an attack's settings pose on a scene.

        Args:
            identifier: name of the frame, which seeds its nuisance samples.
            scene: on the detector's device.
            detector: the detector under attack.
            config: the settings.
            nuisances: nuisances of the margins.
        """
        objective = Objective.from_config(scene, detector, config)
        release_freed_memory()  # stages differ in what they allocate, and holes between long-lived blocks add up
        oracle = NuisanceMarginOracle.for_objective(objective, nuisances, f"search:{identifier}:{config.seed}")
        feasible = objective.feasible_set(only_bounds=config.project == "bounds")
        return cls(oracle, feasible, objective.problem(feasible, config.keep == "last", oracle))

    @property
    def objective(self) -> Objective:
        """The objective of the scene."""
        return self.margin_oracle.objective

    def held_out_margin(self, theta: Tensor) -> float:
        """Mean margin at theta (D,) over held-out nuisance samples, as a margin search measures it."""
        from drivesem.attacks.changes import SAMPLES

        oracle = self.margin_oracle
        numbers = range(FIRST_HELD_OUT_SAMPLE, FIRST_HELD_OUT_SAMPLE + SAMPLES)
        margins = oracle.margins([theta] * SAMPLES, numbers)
        return sum(margin_objective(row, oracle.counted_objects) for row in margins)


@dataclass(frozen=True)
class AttackWorker:
    """Per-process state of an attack, built once and reused for all frames."""

    config: AttackConfig
    """The settings, their budget resolved."""
    params: tuple[Parameter, ...]
    """What the attack moves."""
    method: Attack
    """The algorithm."""
    source: SceneSource
    """Where scenes come from."""
    detector: Predictor
    """The detector under attack."""
    grader: Grader
    """Grades failures."""
    changes: VehicleChangeSettings | None = None
    """Vehicle changes to propose besides theta."""
    memory: SearchMemory = field(default_factory=SearchMemory)
    """What `learn` knows of finished frames."""

    @classmethod
    def from_config(cls, config: AttackConfig, detector: Predictor | None = None) -> AttackWorker:
        """Build the state; `detector`: by default the one that the settings name. Raises UsageError for a detector
        that cannot be used, SceneError for a source that cannot be read.
        """
        config = _resolve_budget(config)
        params, source, method = resolve_parameters(config), open_source(config), build_attack(config)
        detector = load_named_detector(config) if detector is None else detector
        _check_detector(config, detector, method.needs_gradient)
        grader, changes = build_grader(config, detector), _parse_changes(config)
        return cls(config, params, method, source, detector, grader, changes)

    def with_config(self, config: AttackConfig) -> AttackWorker:
        """The same source and detector with other settings."""
        config = _resolve_budget(config)
        return replace(self, config=config, params=resolve_parameters(config), method=build_attack(config))

    def attack_frame(self, identifier: str, out: Path) -> bool:
        """Attack a frame of the source and write its folder; False where it has no vehicle to attack. The result
        stays on disk: a run has thousands of a quarter megabyte each.
        """
        worker = self
        if isinstance(self.method, Learn):
            self.memory.read(out / FRAMES)
            worker = replace(self, method=replace(self.method, knowledge=self.memory.knowledge()))
        try:
            attacked = worker.attack_scene(identifier, self.source.scene(identifier))
        except NoVehicleError:
            return False
        write_frame(attacked, out / FRAMES / identifier)
        return True

    def attack_scene(self, identifier: str, scene: SceneIR) -> AttackedScene:
        """Attack a scene in memory.

        Raises:
            NoVehicleError: the scene has no vehicle, or not all targeted ones.
            SceneError: the scene cannot be used, or a loss or gradient is not finite.
        """
        start = time.perf_counter()
        self._check_vehicles(identifier, scene)
        config, seed = self.config, self._frame_seed(identifier)
        scene = convert_scene(scene, None, detector_device(self.detector))
        method = self.method if config.like is None else _load_placebo(Path(config.like), identifier)
        try:
            instance, other_passes = self._pose(identifier, scene), 0
            theta0 = instance.objective.space.theta0
            if not instance.objective.found_before and config.objective != "phantom":
                result = FixedTheta(theta0)(instance.problem, theta0, seed)  # nothing can be lost
            elif self.changes is None:
                result = method(instance.problem, theta0, seed)
            else:
                instance, result, other_passes = self._search_with_changes(
                    identifier, scene, instance, self.changes
                )
            instance.margin_oracle.clear_cache()
            objective = instance.objective
            evaluation = objective.evaluate(result.theta)
            benign = objective.detect_photograph()
            passes = objective.passes + other_passes
            search_end = time.perf_counter()
            release_freed_memory()
            failures, notes = grade_failures(
                identifier,
                objective,
                instance.feasible,
                result,
                self.grader if config.grade else None,
                seed,
            )
        except (RangeError, ShapeError) as error:
            # The error of a loss or gradient that is not finite names the coordinate, but not the frame.
            raise type(error)(f"frame {identifier}: {error.field}", error.expected, error.actual) from error
        objective.release_layers()
        end = time.perf_counter()
        return AttackedScene(
            identifier=identifier,
            objective=objective,
            search=result,
            rendered=evaluation,
            benign=benign,
            violated_at_start=instance.feasible.violated_at_start,
            failures=failures,
            grade_notes=notes,
            passes=passes,
            visits=objective.cell_visits(evaluation),
            learns=isinstance(method, Learn),
            seconds=end - start,
            grading_seconds=end - search_end,
        )

    def _frame_seed(self, identifier: str) -> int:
        """The seed of a frame's randomness: with one for all, frames of equally many objects would share states."""
        return zlib.crc32(f"{self.config.seed}:{identifier}".encode())

    def _check_vehicles(self, identifier: str, scene: SceneIR) -> None:
        count, rows = len(scene.objects), TargetSelection.from_options(self.config.target_objects, None).objects
        if count == 0:
            kind = "vehicle or person" if self.config.moves_people else "vehicle"
            raise NoVehicleError(f"frame {identifier}", f"a {kind} that can be de-rendered", "none")
        if rows is not None and rows[-1] >= count:
            raise NoVehicleError(
                f"frame {identifier}", f"objects up to the {rows[-1]}th from 0", f"{count} of them"
            )

    def _pose(self, identifier: str, scene: SceneIR) -> AttackInstance:
        nuisances = self.grader.nuisances if self.config.grade else Nuisances()
        return AttackInstance.from_scene(identifier, scene, self.detector, self.config, nuisances)

    def _search_with_changes(
        self, identifier: str, scene: SceneIR, unchanged: AttackInstance, changes: VehicleChangeSettings
    ) -> tuple[AttackInstance, AttackResult, int]:
        """Search theta with a part of the passes, and try vehicle changes at the result with the rest.

        Returns:
            The scene with the lowest margins, the result on it, and the passes that the other scenes took.
        """
        from drivesem.attacks.changes import count_affordable_proposals, proposal_passes, propose_scenes

        config, attack = self.config, self.method
        assert isinstance(attack, MarginSearch)
        count = count_affordable_proposals(attack.passes)
        attack = replace(attack, passes=attack.passes - proposal_passes(count))
        seed = self._frame_seed(identifier)
        result = attack(unchanged.problem, unchanged.objective.space.theta0, seed)
        scenes = propose_scenes(scene, changes, count, seed, RenderSettings(backend=config.backend))
        proposals = (self._pose(identifier, changed) for changed in scenes)
        return _choose_change(unchanged, result, proposals, seed)


def _choose_change(
    unchanged: AttackInstance, result: AttackResult, proposals: Iterable[AttackInstance], seed: int
) -> tuple[AttackInstance, AttackResult, int]:
    """The scene with the lowest margins at the theta found; returns what `_search_with_changes` does."""
    best, least, theta = unchanged, unchanged.held_out_margin(result.theta), result.theta
    all_passes = best_passes = unchanged.margin_oracle.passes
    for proposal in proposals:
        space, oracle = proposal.objective.space, proposal.margin_oracle
        proposal.objective.search_log = unchanged.objective.search_log
        same_theta = space.convert_theta(unchanged.objective.space, result.theta)
        proposal_theta = proposal.problem.project(same_theta).theta
        margin = proposal.held_out_margin(proposal_theta)
        oracle.clear_cache()
        all_passes += oracle.passes
        if margin < least:
            best, least, theta, best_passes = proposal, margin, proposal_theta, oracle.passes
    if best is not unchanged:
        on_change = FixedTheta(theta)(best.problem, best.objective.space.theta0, seed)
        if torch.equal(on_change.theta, theta):  # else its render is not feasible
            trace = (*result.loss_trace, *on_change.loss_trace)
            return best, replace(on_change, queries=result.queries, loss_trace=trace), all_passes - best_passes
    return unchanged, result, all_passes - unchanged.margin_oracle.passes


def _parse_changes(config: AttackConfig) -> VehicleChangeSettings | None:
    """The vehicle changes that the settings allow. Raises FormatError for an unknown change or a bad mesh."""
    if config.changes is None:
        return None
    from drivesem.attacks.changes import VehicleChangeSettings, load_vehicle_mesh, parse_vehicle_changes

    mesh = None if config.mesh is None else load_vehicle_mesh(config.mesh)
    return VehicleChangeSettings(parse_vehicle_changes(config.changes), mesh)


def build_attack(config: AttackConfig) -> Attack:
    """The algorithm that the settings name."""
    early_stop, box_steps = config.early_stop, config.steps if config.range == "steps" else None
    steps, queries = _steps_for_pass_budget(config)
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
        case "learn":
            _check_learning()
            return Learn(config.passes or Learn().passes)
        case "corners":
            return Corners(config.passes or Corners().passes)
        case "placebo":
            return Placebo()
        case "cma-es":
            return CMAES(queries, box_steps, early_stop)
        case "random" | "halton":
            return Sampling(queries, box_steps, early_stop, config.method)


def _check_learning() -> None:
    """Raise UsageError where scikit-learn is not installed."""
    if find_spec("sklearn") is None:
        raise UsageError("--method", "one without scikit-learn, or pip install 'drivesem[learn]'", "learn")


def _steps_for_pass_budget(config: AttackConfig) -> tuple[int, int]:
    """Steps and queries, as many as --passes allows if given.

    A frame takes a few more passes: the photograph, its re-render, and the re-scoring of proposals. Methods that
    count both gradients and renders as queries may need one of each per query.
    """
    if config.passes is None:
        return config.steps, config.queries or DEFAULT_QUERIES
    if config.method in GRADIENT_FREE_METHODS:
        return config.steps, max(config.passes - _FIXED_PASSES, 1)
    step_passes = GRADIENT_PASSES + (config.early_stop or config.method == "scw")
    steps = max((config.passes - _FIXED_PASSES - (MAX_RESCORED + 1)) // step_passes, 2)
    return steps, steps


def build_grader(config: AttackConfig, detector: Predictor) -> Grader:
    """The grader of a run's failures. Raises UsageError for invalid settings."""
    return Grader(
        detector=detector,
        t_star=resolve_t_star(detector, config.t_star),
        nuisances=Nuisances.parse(config.nuisances),
        rule=CertificateRule(config.draws),
        seed=config.seed,
        make_second_renderer=_second_renderer_maker(config) if config.confirm else None,
        load_second_detector=_second_detector_loader(config),
        reference_detector=None
        if config.reference_detector is None
        else _load_reference(config, config.reference_detector),
    )


def _second_renderer_maker(config: AttackConfig) -> Callable[[str, SceneIR], SecondRenderer]:
    """Makes the second renderer of a frame; its modules load with the first failure to confirm."""

    @cache
    def renderers() -> SecondRenderers:
        from drivesem.failures.second_renderer.selection import SecondRenderers

        return SecondRenderers(config.dataset, config.root)

    return lambda identifier, scene: renderers().renderer_for(identifier, scene)


def _second_detector_loader(config: AttackConfig) -> Callable[[], Predictor] | None:
    """Loads the detector of another architecture; None without one."""
    if config.second_detector == "off" or not config.confirm:
        return None
    if config.second_detector == "auto":
        name = next(name for name in SECOND_DETECTORS if name != config.detector)
        return cache(partial(load_predictor, name, config.device, config.tiles))
    try:
        detector = load_predictor(config.second_detector, config.device, config.tiles)
        EvaluatedClasses.from_detector(detector)
    except DetectorError as error:
        raise UsageError.from_detector_error("--second-detector", "auto, off, or a detector", error) from error
    return lambda: detector


def _load_reference(config: AttackConfig, name: str) -> Callable[[Tensor], Tensor]:
    try:
        return make_reference_detector(load_predictor(name, config.device, config.tiles))
    except DetectorError as error:
        raise UsageError.from_detector_error("--reference-detector", "a detector", error) from error


def _load_placebo(run: Path, identifier: str) -> Placebo:
    """An edit as large as a run's change of the frame. Raises FormatError where the run has no such frame."""
    return Placebo(tuple(c.value for c in load_frame(run / FRAMES / identifier / RESULT).theta))


def load_named_detector(config: AttackConfig) -> Predictor:
    """Load the detector under attack. Raises UsageError for an unknown one."""
    try:
        if config.precision == "float32":
            return load_predictor(config.detector, config.device, config.tiles)
        return load_detector(config.detector, config.device, getattr(torch, config.precision))
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector", error) from error


def with_gradient_free_fallback(config: AttackConfig, detector: Predictor) -> AttackConfig:
    """The settings, with GRADIENT_FREE_FALLBACK for the default method where the detector has no gradient."""
    if isinstance(detector, Detector) or config.method != AttackConfig().method:
        return config
    fallback = replace(config, method=GRADIENT_FREE_FALLBACK)
    fallback.check()
    return fallback


def report_fallback(config: AttackConfig, usable: AttackConfig, detector: Predictor) -> None:
    """Write a line to standard error if `with_gradient_free_fallback` has replaced the method."""
    if usable.method != config.method:
        without = f"{config.detector} has no gradient{explain_missing_gradient(detector)}"
        sys.stderr.write(f"{without}: method {usable.method} takes the place of {config.method}\n")


def _check_detector(config: AttackConfig, detector: Predictor, needs_gradient: bool) -> None:
    """Raise UsageError for a detector that knows no cars, or lacks a gradient that the settings need."""
    try:
        EvaluatedClasses.from_detector(detector)
    except DetectorError as error:
        raise UsageError.from_detector_error("--detector", "a detector", error) from error
    if isinstance(detector, Detector):
        return
    without = f"{config.detector}, which has no gradient{explain_missing_gradient(detector)}"
    if needs_gradient:
        expected = f"one of {', '.join(_METHODS_WITHOUT_GRADIENT)} for {without}"
        raise UsageError("--method", expected, config.method)
    if config.objective not in GRADIENT_FREE_TERMS:
        expected = f"one of {', '.join(GRADIENT_FREE_TERMS)} for {without}"
        raise UsageError("--objective", expected, config.objective)


def select_frames(source: SceneSource, config: FrameCommandConfig) -> tuple[list[str], int, dict[str, str]]:
    """The frames to attack, the number passed over without vehicles, and the unreadable ones with the reason."""
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


def _select_part(names: list[str], part: str | None) -> list[str]:
    """Every N-th frame from the K-th on, so that all parts take about as long."""
    if part is None:
        return names
    number, count = parse_part("--part", part)
    return names[number - 1 :: count]


def _run_name(config: AttackConfig, params: tuple[Parameter, ...]) -> str:
    method = "" if config.method == AttackConfig().method else f"-{config.method}"
    return f"{config.dataset}-{'-'.join(params)}{method}-seed{config.seed}"


def summarise_run(
    config: AttackConfig, params: tuple[Parameter, ...], detector: Predictor, results: Sequence[FrameResult]
) -> RunSummary:
    """The metrics of a run that follow from its settings and frames.

    Args:
        config: the settings.
        params: the attacked parameters.
        detector: the attacked detector.
        results: of all frames.
    """
    t_star, classes = resolve_t_star(detector, config.t_star), EvaluatedClasses.from_detector(detector)
    headline = TargetSelection.from_options(config.target_objects, config.target_classes).headline(classes.names)
    return RunSummary(
        out="",
        dataset=config.dataset,
        params=tuple(str(p) for p in params),
        detector=config.detector,
        headline=headline,
        t_star=t_star,
        frames_without_vehicles=0,
        frames_failed={},
        seconds=0.0,
        **({} if config.changes else estimate_rates(results)),
        **summarise_frames(results, classes, t_star, headline),
    )


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
