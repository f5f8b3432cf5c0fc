"""Explains failures of a run: which parameters and objects cause each, and how little of the change keeps it."""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from detectors.base import Detector
from detectors.types import CLASSES
from drivesem.analysis.explain import sensitivity
from drivesem.analysis.explain.attribution import (
    EXPLANATION,
    MOST_EXACT,
    SCHEMA,
    Contribution,
    Explanation,
    FailureExplanation,
    Flags,
    Floats,
    MinimalChange,
    MinimalChangeSearch,
    PartOutcome,
    PixelSensitivity,
    ShortenedChange,
    ThetaBlock,
    ThetaPart,
    find_minimal_change,
    list_object_parameters,
    measure_change,
    shapley_values,
    split_by_object,
    split_by_parameter,
)
from drivesem.analysis.explain.report import (
    build_explain_report,
    exchange_note,
    minimal_picture,
    plot_waterfalls,
    sort_failures,
    summarise_parameters,
)
from drivesem.attacks.budgets import change_limits
from drivesem.attacks.feasibility_check import check_scene
from drivesem.attacks.methods.base import Problem
from drivesem.attacks.objective import Objective, RenderEvaluation
from drivesem.attacks.space import ParameterSpace, parse_params
from drivesem.config.commands import ExplainConfig
from drivesem.config.errors import UsageError
from drivesem.evaluation.resampling import DRAWS
from drivesem.failures.grades import AGREEMENT_RULE, Grade
from drivesem.failures.grading import Grader
from drivesem.failures.kinds import Fault, find_same_fault
from drivesem.reporting.tables import AnalysisReport, format_count
from drivesem.run.attack import build_grader
from drivesem.run.driver import FrameAnalyser, ProgressSettings, analyse_frames
from drivesem.run.finished import AttackRun, ChangedState, RebuiltFrame, load_runs
from drivesem.run.folder import FRAMES, PRESENTATION, claim_folder, load_run_detector, load_trusted_config
from drivesem.run.frame import (
    build_failure_records,
    detection_records,
    has_grade,
    target_records,
)
from drivesem.run.report import pictures
from drivesem.run.results import Coordinate, Failure
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import to_uint8

_WRITTEN = ("explain.json", "explain.md", "explain.csv", "explain_failures.csv", "explain.png", FRAMES)
_FREE = (*PRESENTATION, "run", "frame", "bootstrap")
"""Settings that do not affect a frame's explanation."""


def run_explain(config: ExplainConfig) -> AnalysisReport:
    """Explain a run's counterexamples, or resume, and write the report.

    Raises UsageError or SceneError for bad input.
    """
    (run,) = load_runs([config.run or ""])
    names = _choose_frames(run, config)
    out = Path(config.out) if config.out else run.folder / "explain"
    make_analyser = partial(ExplainAnalyser, config, run, out)
    analyser = make_analyser()
    claim_folder(out, config, _WRITTEN, _FREE)
    results, failed = analyse_frames(names, analyser, make_analyser, config, ProgressSettings("explaining frames"))
    explanations = [one for one in results if one.contributions]
    by_exchange = [one.identifier for one in results if not one.contributions]
    if not explanations:
        reasons = "; ".join([*failed.values(), *([exchange_note(by_exchange)] if by_exchange else [])])
        raise UsageError("--run", "a run with frames that can be explained", reasons)
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
    parameters = summarise_parameters(explanations, draws, config.seed)
    report = build_explain_report(out, explanations, parameters, draws, facts)
    report.write()
    return report


def _choose_frames(run: AttackRun, config: ExplainConfig) -> list[str]:
    """Return the frames that fail with moved labels, or those of --frame. Raises UsageError if there are none."""
    fails = {frame.result.identifier: frame.result.success_moved for frame in run.frames}
    requested = [part.strip() for part in (config.frame or "").split(",") if part.strip()]
    for name in requested:
        if name not in fails:
            raise UsageError("--frame", f"a frame of {run.folder}", name)
        if not fails[name]:
            raise UsageError("--frame", "frames that fail, by moved labels", f"{name}, which does not")
    names = [name for name in fails if fails[name] and (not requested or name in requested)]
    if not names:
        raise UsageError(
            "--run", "a run with counterexamples, by moved labels", f"none in {format_count(len(fails), 'frame')}"
        )
    return names[: config.limit]


@dataclass(frozen=True, slots=True)
class ExplainBudget:
    """Effort spent on one counterexample."""

    points: int
    """Points of the grid of scales."""
    permutations: int
    """Sampled orders of more than MOST_EXACT parts; an even number."""
    seed: int
    """Seed of the orders."""


MIN_CHECK_DRAWS = AGREEMENT_RULE[1]
"""Draws that test a change in the search, doubled up to those of the certificate until the whole change holds."""


@dataclass(frozen=True, slots=True)
class TrackedFailure:
    """A failure of the run, to be found again after other changes of its frame."""

    record: Failure
    """As the run graded it."""
    fault: Fault | None
    """The same as a fault; None for a failure of no kind."""

    @classmethod
    def list_occurring(cls, records: Sequence[Failure], state: ChangedState) -> list[TrackedFailure]:
        """List the failures of a kind, or all if there are none, that occur at the counterexample."""
        of_kind = [record for record in records if record.error is not None]
        return [
            tracked
            for record in of_kind or records
            if (tracked := cls(record, state.find_recorded_fault(record))).occurs(state)
        ]

    @property
    def certain(self) -> bool:
        """Whether the run graded it certain or higher."""
        return has_grade(Grade.CERTAIN)(self.record)

    def occurs(self, state: ChangedState) -> bool:
        """Whether it occurs in a picture: the same object fails in the same kind."""
        if state.hidden:
            return False
        return (
            self.fault_in(state) is not None if self.fault is not None else state.shows_by_threshold(self.record)
        )

    def fault_in(self, state: ChangedState) -> Fault | None:
        """Find it among the faults of a state."""
        assert self.fault is not None
        place, detections = torch.tensor(self.record.xyxy), state.evaluation.detections
        return find_same_fault(state.faults, self.fault, place, detections)


class PartialChangeEvaluator:
    """Evaluates the detector on parts of a change, and follows failures through them."""

    def __init__(self, problem: Problem, evaluate_state: Callable[[Tensor], ChangedState], grader: Grader) -> None:
        self._problem, self._evaluate_state, self._grader = problem, evaluate_state, grader
        self._occurs: dict[bytes, tuple[bool, ...]] = {}
        self.tracked: Sequence[TrackedFailure] = ()
        """Failures that `outcome` looks for."""

    @property
    def renders(self) -> int:
        """Number of different thetas evaluated."""
        return len(self._occurs)

    def outcome(self, theta: Tensor, mask: Tensor) -> PartOutcome:
        """Evaluate theta (D,) with the coordinates outside `mask` (D,) bool reset and the rest projected."""
        masked = torch.where(mask, theta, 0)
        part = self.project(masked)
        occurs, score = self.occurs(part), self._problem.score(part)
        held_back = not torch.equal(part, masked)
        return PartOutcome(score.loss, score.lost, score.phantoms, score.success, held_back, occurs)

    def occurs(self, theta: Tensor) -> tuple[bool, ...]:
        """Whether each failure occurs in the picture of a feasible theta (D,)."""
        key = theta.cpu().numpy().tobytes()
        if key not in self._occurs:
            state = self._evaluate_state(theta)
            self._occurs[key] = tuple(tracked.occurs(state) for tracked in self.tracked)
        return self._occurs[key]

    def count_draws(self, theta: Tensor, row: int, draws: int, enough: int = 0) -> int:
        """Count the draws that show a failure at a feasible theta (D,).

        Args:
            theta: The state.
            row: Number of the failure.
            draws: Number of draws.
            enough: Stop as soon as this many can no longer be reached.
        """
        state, tracked = self._evaluate_state(theta), self.tracked[row]
        fault = None if tracked.fault is None else tracked.fault_in(state)
        return 0 if fault is None else self._grader.count_wrong(state.case, fault, draws, enough)

    def choose_draws(self, theta: Tensor, row: int) -> int:
        """Choose the fewest draws in which a certain failure holds at its counterexample theta (D,)."""
        draws = MIN_CHECK_DRAWS
        while draws < self._grader.rule.draws and not self.holds(theta, row, draws):
            draws *= 2
        return min(draws, self._grader.rule.draws)

    def enough(self, draws: int) -> int:
        """Return how many of that many draws must show a failure, by the share that a certificate needs."""
        return math.ceil(self._grader.rule.wrong_after * draws)

    def holds(self, theta: Tensor, row: int, draws: int) -> bool:
        """Whether a failure occurs in the picture and in enough draws."""
        enough = self.enough(draws)
        return self.occurs(theta)[row] and self.count_draws(theta, row, draws, enough) >= enough

    def project(self, theta: Tensor) -> Tensor:
        """Project theta (D,) onto the feasible set."""
        return self._problem.project(theta).theta

    def size(self, theta: Tensor) -> float:
        """Return the size of theta (D,) in steps (`Problem.size`)."""
        return float(self._problem.size(theta))

    def make_search(self, points: int, row: int, draws: int) -> MinimalChangeSearch:
        """Make the search for the smallest change that keeps a failure.

        Args:
            points: Points of the grid of scales.
            row: Number of the failure.
            draws: Draws in which it must hold; 0 if the picture decides.
        """

        def keeps(theta: Tensor) -> bool:
            return self.holds(theta, row, draws) if draws else self.occurs(theta)[row]

        return MinimalChangeSearch(self.project, lambda theta: self.occurs(theta)[row], keeps, self.size, points)


class ExplainAnalyser(FrameAnalyser[Explanation]):
    """Explains counterexamples of a run."""

    file, kind, schema = EXPLANATION, Explanation, SCHEMA

    def __init__(self, config: ExplainConfig, run: AttackRun, out: Path) -> None:
        super().__init__(run.folder, out)
        attack = load_trusted_config(run.folder, config.trust)
        whole = config.resolve_whole(attack.whole)
        self.attack = replace(attack, whole=whole, incremental=False, keep_mb=config.keep_mb)
        self.params, self.detector = parse_params(run.params), load_run_detector(attack, config.device)
        self.budget = ExplainBudget(config.points, config.permutations, config.seed)
        self.grader = build_grader(replace(attack, confirm=False), self.detector)

    def analyse(self, name: str, folder: Path) -> Explanation:
        """See `FrameAnalyser`. Failures by the exchange of vehicles alone have no contributions.

        Raises FormatError if none of the failures occurs on this machine, RangeError for a gradient that is not
        finite.
        """
        start = time.perf_counter()
        frame_folder, budget = self.run_folder / FRAMES / name, self.budget
        frame = RebuiltFrame.load(frame_folder, self.attack, self.params, self.detector)
        objective, theta, space = frame.objective, frame.theta, frame.objective.space
        evaluate_state = partial(frame.evaluate_state, self.grader)
        evaluator = PartialChangeEvaluator(objective.problem(frame.feasible), evaluate_state, self.grader)
        records = sort_failures(frame.result.failures)
        evaluator.tracked = TrackedFailure.list_occurring(records, evaluate_state(evaluator.project(theta)))
        if not evaluator.tracked:
            raise FormatError(
                str(frame_folder), "a counterexample that fails", "one that the detector gets right here"
            )
        everything = torch.ones_like(theta, dtype=torch.bool)
        found, benign = evaluator.outcome(theta, everything), evaluator.outcome(theta, ~everything)
        parts = {"parameter": split_by_parameter(space, theta), "object": split_by_object(space, theta)}
        slope = objective.loss_and_grad(space.theta0)[1] * theta if isinstance(self.detector, Detector) else None
        generator = np.random.default_rng([budget.seed, zlib.crc32(name.encode())])
        contributions: list[Contribution] = []
        if not all(benign.occurs):
            for own in parts.values():
                contributions += compute_contributions(
                    own, theta, evaluator, slope, budget.permutations, generator
                )
        blocks = _order_blocks(space, theta, [*parts["parameter"], *parts["object"]], contributions, evaluator)
        explained = [
            _explain_failure(frame, evaluator, row, blocks, budget.points) for row in range(len(evaluator.tracked))
        ]
        gradients = _pixel_gradients(objective, theta)
        explanation = Explanation(
            identifier=name,
            source=self.source_digest(name),
            objects=frame.result.objects,
            benign=benign,
            found=found,
            contributions=tuple(contributions),
            exact=tuple(kind for kind, own in parts.items() if len(own) <= MOST_EXACT),
            sizes=tuple(measure_change(space, theta)),
            failures=tuple(one for one, _ in explained),
            sensitivity={view: _sensitivity_shares(*pair) for view, pair in gradients.items()},
            renders=evaluator.renders,
            seconds=round(time.perf_counter() - start, 3),
        )
        _write_pictures(folder, explanation, objective, [rendered for _, rendered in explained], gradients)
        return explanation


def _explain_failure(
    frame: RebuiltFrame, evaluator: PartialChangeEvaluator, row: int, blocks: Sequence[ThetaBlock], points: int
) -> tuple[FailureExplanation, RenderEvaluation | None]:
    """Find the smallest change that keeps a failure, and render it.

    Args:
        frame: The frame.
        evaluator: Evaluates the detector.
        row: Number of the failure.
        blocks: Blocks to drop, in this order.
        points: Points of the grid of scales.
    """
    theta, tracked, theta0 = frame.theta, evaluator.tracked[row], frame.objective.space.theta0
    if evaluator.occurs(evaluator.project(theta0))[row]:
        return FailureExplanation(tracked.record, None, "the exchange of objects alone causes it"), None
    whole = evaluator.project(theta)
    draws = evaluator.choose_draws(whole, row) if tracked.certain else MIN_CHECK_DRAWS
    must_hold = tracked.certain and evaluator.holds(whole, row, draws)
    others = torch.zeros_like(theta, dtype=torch.bool)
    for cell in list_object_parameters(frame.objective.space):
        others[cell.where] = cell.object not in (None, tracked.record.index)
    first = [] if tracked.record.index is None else [ThetaBlock("other objects", others)]
    search = evaluator.make_search(points, row, draws if must_hold else 0)
    shortened = find_minimal_change(theta, [*first, *blocks], search)
    rendered = frame.objective.evaluate(shortened.theta)
    wrong = evaluator.count_draws(shortened.theta, row, draws)
    least = replace(
        _describe_minimal_change(frame, evaluator, shortened, rendered),
        draws=wrong,
        of=draws if tracked.fault is not None else 0,
        holds=wrong >= evaluator.enough(draws),
    )
    return FailureExplanation(tracked.record, least), rendered


def compute_contributions(
    parts: Sequence[ThetaPart],
    theta: Tensor,
    evaluator: PartialChangeEvaluator,
    slope: Tensor | None,
    permutations: int,
    generator: np.random.Generator,
) -> list[Contribution]:
    """Compute the Shapley value of each part of a change.

    Args:
        parts: Parts that together cover theta.
        theta: The change (D,).
        evaluator: Evaluates the detector.
        slope: Gradient at theta0 times theta (D,), if the detector has a gradient.
        permutations: Sampled orders of more than MOST_EXACT parts.
        generator: Draws the orders.
    """
    masks = torch.stack([part.mask for part in parts])
    outcomes: dict[bytes, PartOutcome] = {}

    def outcome(members: Flags) -> PartOutcome:
        key = members.tobytes()
        if key not in outcomes:
            outcomes[key] = evaluator.outcome(theta, masks[torch.from_numpy(members)].any(dim=0))
        return outcomes[key]

    def game(members: Flags) -> Floats:
        one = outcome(members)
        return np.array([one.loss, *one.occurs], dtype=np.float64)

    values = shapley_values(game, len(parts), permutations, generator)
    total_slope = None if slope is None else float(slope.abs().sum())
    contributions: list[Contribution] = []
    for i, part in enumerate(parts):
        alone = np.arange(len(parts)) == i
        loss, *fails = values.contributions[i].tolist()
        errors = None if values.errors is None else values.errors[i].tolist()
        own_slope = None if slope is None else slope[part.mask]
        share = float(own_slope.abs().sum()) / total_slope if own_slope is not None and total_slope else None
        contributions.append(
            Contribution(
                kind=part.kind,
                name=part.name,
                loss=loss,
                loss_error=None if errors is None else errors[0],
                fails=tuple(fails),
                fails_error=None if errors is None else tuple(errors[1:]),
                gradient=None if own_slope is None else float(own_slope.sum()),
                gradient_share=share,
                alone=outcome(alone),
                without=outcome(~alone),
            )
        )
    return contributions


def _order_blocks(
    space: ParameterSpace,
    theta: Tensor,
    parts: Sequence[ThetaPart],
    contributions: Sequence[Contribution],
    evaluator: PartialChangeEvaluator,
) -> list[ThetaBlock]:
    """Order the blocks to drop: parameters and objects by their contribution to the loss, the least first; then
    single parameters of single objects, the smallest first.
    """
    loss = {c.name: c.loss for c in contributions}
    blocks = [
        ThetaBlock(part.name, part.mask) for part in sorted(parts, key=lambda part: loss.get(part.name, 0.0))
    ]
    single: list[tuple[float, ThetaBlock]] = []
    for cell in list_object_parameters(space):
        mask = torch.zeros_like(theta, dtype=torch.bool)
        mask[cell.where] = True
        single.append((evaluator.size(torch.where(mask, theta, 0)), ThetaBlock(cell.name, mask)))
    return blocks + [block for size, block in sorted(single, key=lambda pair: pair[0]) if size > 0]


def _describe_minimal_change(
    frame: RebuiltFrame, evaluator: PartialChangeEvaluator, shortened: ShortenedChange, rendered: RenderEvaluation
) -> MinimalChange:
    objective, space, minimal = frame.objective, frame.objective.space, shortened.theta
    violations = check_scene(
        space.scene,
        rendered.scene,
        joint_weather=frame.result.joint_weather,
        limits=change_limits(space.budget, space.parametrisation),
    )
    return MinimalChange(
        draws=0,
        of=0,
        holds=False,
        scan=shortened.scan,
        sign_changes=shortened.sign_changes,
        scale_whole=shortened.shortened_scale,
        scale=shortened.scale,
        dropped=shortened.dropped,
        norm_found=evaluator.size(frame.theta),
        norm_whole=evaluator.size(shortened.shortened),
        norm=evaluator.size(minimal),
        outcome=evaluator.outcome(minimal, torch.ones_like(minimal, dtype=torch.bool)),
        violations=tuple(violations),
        sizes=tuple(measure_change(space, minimal)),
        failures=build_failure_records(
            objective.classes, rendered.moved.targets, rendered.detections, objective.failures(rendered, "moved")
        ),
        theta=tuple(
            Coordinate(name=name, **facts)  # pyright: ignore[reportArgumentType]
            for name, facts in space.theta_by_name(minimal).items()
            if facts["value"] != 0
        ),
    )


def _pixel_gradients(
    objective: Objective, theta: Tensor
) -> dict[str, tuple[RenderEvaluation, sensitivity.Floats]]:
    """Return the benign re-render and the counterexample with the gradient (H, W) of the loss to their pixels;
    nothing if the detector has no gradient.
    """
    if not isinstance(objective.detector, Detector):
        return {}
    pair = {"benign": objective.benign, "counterexample": objective.evaluate(theta)}
    return {name: (one, sensitivity.pixel_gradient(objective, one)) for name, one in pair.items()}


def _sensitivity_shares(rendered: RenderEvaluation, gradient: sensitivity.Floats) -> PixelSensitivity:
    ids = rendered.render.object_id.cpu().numpy()
    *objects, background = sensitivity.gradient_shares(gradient, ids, len(rendered.scene.objects))
    return PixelSensitivity(tuple(objects), background)


def _write_pictures(
    folder: Path,
    explanation: Explanation,
    objective: Objective,
    rendered: Sequence[RenderEvaluation | None],
    gradients: Mapping[str, tuple[RenderEvaluation, sensitivity.Floats]],
) -> None:
    """Write a frame's pictures. rendered: the minimal change of each failure."""
    for number, (explained, minimal) in enumerate(zip(explanation.failures, rendered, strict=True)):
        if minimal is None or explained.least is None:
            continue
        image = to_uint8(minimal.render.image)
        files.write_png(folder / f"{minimal_picture(number)}.png", image)
        overlay = pictures.draw_overlay(
            image,
            target_records(minimal.moved.targets, CLASSES, explanation.objects),
            detection_records(minimal.detections, objective.classes.names),
            explained.least.failures,
            objective.t_star,
            sensitivity.place_object_numbers((image.shape[1], image.shape[0]), _object_boxes(minimal)),
        )
        files.write_png(folder / f"{minimal_picture(number)}_overlay.png", overlay)
    if gradients:
        rows = [
            (name, to_uint8(one.render.image), _object_boxes(one), gradient)
            for name, (one, gradient) in gradients.items()
        ]
        files.write_png(folder / "sensitivity.png", sensitivity.draw_sensitivity_sheet(rows))
    if explanation.contributions:
        plot_waterfalls(folder / "shapley.png", explanation)


def _object_boxes(rendered: RenderEvaluation) -> sensitivity.Floats:
    """Boxes of the objects (N, 4) xyxy, px."""
    return rendered.moved.boxes_xyxy.cpu().numpy()
