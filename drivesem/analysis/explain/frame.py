"""One counterexample, from the folder of its run to the folder of its explanation."""

from __future__ import annotations

import time
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from detectors.base import Detector, Predictor
from detectors.types import CLASSES
from drivesem.analysis.explain import players, sensitivity
from drivesem.analysis.explain.minimal import LeastSearch, Minimal, ThetaBlock, minimal
from drivesem.analysis.explain.players import Kind, Player
from drivesem.analysis.explain.plots import write_waterfalls
from drivesem.analysis.explain.results import (
    EXPLANATION,
    Contribution,
    Explanation,
    Least,
    PartOutcome,
    Sensitivity,
    write_explanation,
)
from drivesem.analysis.explain.shapley import MOST_EXACT, Flags, Floats, shapley
from drivesem.attack.budgets import reach_of
from drivesem.attack.feasibility_check import check_scene
from drivesem.attack.feasible.bounds import Limits
from drivesem.attack.methods.base import Problem, Score
from drivesem.attack.objective import Objective, Rendered
from drivesem.attack.space import Parameter, ParameterSpace
from drivesem.config.commands import Attack
from drivesem.run.frame import RESULT, detection_records, failure_records, target_records
from drivesem.run.rebuilt import rebuilt
from drivesem.run.report import pictures
from drivesem.run.results import Coordinate, load_frame
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import to_uint8

KINDS: tuple[Kind, ...] = ("parameter", "object")


@dataclass(frozen=True, slots=True)
class Effort:
    """How closely to look. points: of the grid of scales; permutations: walks through more than MOST_EXACT cars,
    drawn from `seed`; lost: the least change of a counterexample that loses objects must lose one too.
    """

    points: int
    permutations: int
    seed: int
    lost: bool = False


class Judge:
    """What the detector makes of parts of a change. renders: thetas that were judged, each once."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._seen: set[bytes] = set()

    @property
    def renders(self) -> int:
        return len(self._seen)

    def outcome(self, theta: Tensor, mask: Tensor) -> PartOutcome:
        """Of theta (D,) with the coordinates outside of `mask` (D,) bool as photographed, projected."""
        wanted = torch.where(mask, theta, 0)
        part = self.project(wanted)
        score = self._score(part)
        return PartOutcome(score.loss, score.lost, score.phantoms, score.success, not torch.equal(part, wanted))

    def project(self, theta: Tensor) -> Tensor:
        """theta (D,), feasible."""
        return self._problem.project(theta).theta

    def size(self, theta: Tensor) -> float:
        """Of theta (D,) in steps, by group (`Problem.size`)."""
        return float(self._problem.size(theta))

    def search(self, points: int, lost: bool) -> LeastSearch:
        """For the least change that fails, or that loses an object."""

        def fails(theta: Tensor) -> bool:
            score = self._score(theta)
            return score.lost > 0 if lost else score.success

        return LeastSearch(self.project, fails, self.size, points)

    def _score(self, theta: Tensor) -> Score:
        self._seen.add(theta.cpu().numpy().tobytes())
        return self._problem.score(theta)


def explain_frame(
    folder: Path,
    attack: Attack,
    params: Sequence[Parameter],
    detector: Predictor,
    effort: Effort,
    out: Path,
) -> Explanation:
    """Explain the counterexample in a run's folder of one frame, and write the folder `out`, whole or not at all.
    Of a scene that fails by the exchange of its vehicles alone there is nothing to weigh or to take back.

    attack, params: the run's. Raises FormatError where the scene is not there or is damaged, or the detector does
    not fail on it on this machine; RangeError for a gradient that is not finite.
    """
    start = time.perf_counter()
    result = load_frame(folder / RESULT)
    objective, theta = rebuilt(result, folder, attack, params, detector)
    space = objective.space
    limits, only_bounds = Limits(joint_weather=result.joint_weather), attack.project == "bounds"
    judge = Judge(objective.problem(objective.feasible_set(limits, only_bounds)))
    everything = torch.ones_like(theta, dtype=torch.bool)
    found = judge.outcome(theta, everything)
    if not found.success:
        raise FormatError(str(folder), "a counterexample that fails", "one that the detector gets right here")
    teams = {"parameter": players.parameters(space, theta), "object": players.objects(space, theta)}
    slope = objective.loss_and_grad(space.theta0)[1] * theta if isinstance(detector, Detector) else None
    generator = np.random.default_rng([effort.seed, zlib.crc32(result.identifier.encode())])
    search = judge.search(effort.points, effort.lost and found.lost > 0)
    contributions: list[Contribution] = []
    if search.fails(space.theta0):
        shortened = Minimal(space.theta0, 0.0, (True, True), space.theta0, 0.0, ())
    else:
        for team in teams.values():
            contributions += weigh(team, theta, judge, slope, effort.permutations, generator)
        shortened = minimal(theta, _blocks(space, theta, teams, contributions, judge), search)
    least = objective.evaluate(shortened.theta)
    views = _views(objective, theta)
    explanation = Explanation(
        identifier=result.identifier,
        source=files.digest(folder / RESULT),
        objects=result.objects,
        benign=judge.outcome(theta, ~everything),
        found=found,
        contributions=tuple(contributions),
        exact=tuple(kind for kind in KINDS if len(teams[kind]) <= MOST_EXACT),
        sizes=tuple(players.sizes(space, theta)),
        least=_least(objective, judge, theta, shortened, least, result.joint_weather),
        sensitivity={name: _shares(*view) for name, view in views.items()},
        renders=judge.renders,
        seconds=round(time.perf_counter() - start, 3),
    )
    with files.whole_folder(out) as part:
        _write(part, explanation, objective, least, views)
    return explanation


def weigh(
    team: Sequence[Player],
    theta: Tensor,
    judge: Judge,
    slope: Tensor | None,
    permutations: int,
    generator: np.random.Generator,
) -> list[Contribution]:
    """What each player of a team, which covers theta (D,), adds. slope (D,): gradient at theta0 times theta."""
    masks = torch.stack([player.mask for player in team])
    known: dict[bytes, PartOutcome] = {}

    def outcome(members: Flags) -> PartOutcome:
        key = members.tobytes()
        if key not in known:
            known[key] = judge.outcome(theta, masks[torch.from_numpy(members)].any(dim=0))
        return known[key]

    def game(members: Flags) -> Floats:
        one = outcome(members)
        return np.array([one.loss, one.success], dtype=np.float64)

    shares = shapley(game, len(team), permutations, generator)
    steepness = None if slope is None else float(slope.abs().sum())
    contributions: list[Contribution] = []
    for i, player in enumerate(team):
        alone = np.arange(len(team)) == i
        errors = (None, None) if shares.errors is None else tuple(shares.errors[i].tolist())
        part = None if slope is None else slope[player.mask]
        contributions.append(
            Contribution(
                kind=player.kind,
                name=player.name,
                loss=float(shares.contributions[i, 0]),
                loss_error=errors[0],
                fails=float(shares.contributions[i, 1]),
                fails_error=errors[1],
                gradient=None if part is None else float(part.sum()),
                gradient_share=float(part.abs().sum()) / steepness if part is not None and steepness else None,
                alone=outcome(alone),
                without=outcome(~alone),
            )
        )
    return contributions


def _blocks(
    space: ParameterSpace,
    theta: Tensor,
    teams: Mapping[str, Sequence[Player]],
    contributions: Sequence[Contribution],
    judge: Judge,
) -> list[ThetaBlock]:
    """What to try to leave out: parameters and cars, those first that add least to the loss; then single
    parameters of single cars, the smallest first.
    """
    added = {c.name: c.loss for c in contributions}
    whole = sorted((p for team in teams.values() for p in team), key=lambda player: added[player.name])
    blocks = [ThetaBlock(player.name, player.mask) for player in whole]
    parts: list[tuple[float, ThetaBlock]] = []
    for cell in players.cells(space):
        mask = torch.zeros_like(theta, dtype=torch.bool)
        mask[cell.where] = True
        parts.append((judge.size(torch.where(mask, theta, 0)), ThetaBlock(cell.name, mask)))
    return blocks + [block for size, block in sorted(parts, key=lambda part: part[0]) if size > 0]


def _least(
    objective: Objective, judge: Judge, theta: Tensor, shortened: Minimal, rendered: Rendered, joint_weather: bool
) -> Least:
    space, small = objective.space, shortened.theta
    return Least(
        scan=shortened.scan,
        sign_changes=shortened.sign_changes,
        scale_whole=shortened.shortened_scale,
        scale=shortened.scale,
        dropped=shortened.dropped,
        norm_found=judge.size(theta),
        norm_whole=judge.size(shortened.shortened),
        norm=judge.size(small),
        outcome=judge.outcome(small, torch.ones_like(small, dtype=torch.bool)),
        violations=tuple(
            check_scene(
                space.scene,
                rendered.scene,
                joint_weather=joint_weather,
                reach=reach_of(space.budget, space.parametrisation),
            )
        ),
        sizes=tuple(players.sizes(space, small)),
        failures=failure_records(
            objective.judged, rendered.moved.targets, rendered.detections, objective.failures(rendered, "moved")
        ),
        theta=tuple(
            Coordinate(name=name, **facts)  # pyright: ignore[reportArgumentType]
            for name, facts in space.theta_by_name(small).items()
            if facts["value"] != 0
        ),
    )


def _views(objective: Objective, theta: Tensor) -> dict[str, tuple[Rendered, sensitivity.Floats]]:
    """The benign re-render and the counterexample with the loss's gradient (H, W) to their pixels; empty where the
    detector has none.
    """
    if not isinstance(objective.detector, Detector):
        return {}
    pair = {"benign": objective.benign, "counterexample": objective.evaluate(theta)}
    return {name: (one, sensitivity.pixel_gradient(objective, one)) for name, one in pair.items()}


def _shares(rendered: Rendered, gradient: sensitivity.Floats) -> Sensitivity:
    ids = rendered.render.object_id.cpu().numpy()
    *objects, background = sensitivity.shares(gradient, ids, len(rendered.scene.objects))
    return Sensitivity(tuple(objects), background)


def _write(
    part: Path,
    explanation: Explanation,
    objective: Objective,
    least: Rendered,
    views: Mapping[str, tuple[Rendered, sensitivity.Floats]],
) -> None:
    image = to_uint8(least.render.image)
    files.write_png(part / "minimal.png", image)
    marked = pictures.overlay(
        image,
        target_records(least.moved.targets, CLASSES, explanation.objects),
        detection_records(least.detections, objective.judged.names),
        explanation.least.failures,
        objective.t_star,
        sensitivity.numbers((image.shape[1], image.shape[0]), _boxes(least)),
    )
    files.write_png(part / "minimal_overlay.png", marked)
    if views:
        rows = [
            (name, to_uint8(one.render.image), _boxes(one), gradient) for name, (one, gradient) in views.items()
        ]
        files.write_png(part / "sensitivity.png", sensitivity.sheet(rows))
    if explanation.contributions:
        write_waterfalls(part / "shapley.png", explanation)
    write_explanation(part / EXPLANATION, explanation)


def _boxes(rendered: Rendered) -> sensitivity.Floats:
    """Of the objects (N, 4) px, where they are."""
    return rendered.moved.boxes_xyxy.cpu().numpy()
