"""Fits the fidelity of edited objects to generated streets, which the generator renders after every edit, too.

Streets are de-rendered twice: with their 3D labels, and with boxes alone, those a little off and in a picture of
unknown focal length. In some, the camera's own car is in the picture.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.stats import rankdata

from drivesem.attacks.scene_edits import apply_changes
from drivesem.attacks.space import ground_axes
from drivesem.config.edits import FrameEdit, ObjectEdit
from drivesem.evaluation.resampling import DRAWS
from drivesem.failures.fidelity import ERROR_SCALE, ERROR_WEIGHTS, measure_fidelity
from drivesem.reporting.plots import write_scatter
from drivesem.reporting.tables import AnalysisReport, ReportTable
from drivesem.scenes.label_free import FIT_TO_LABELS, estimate_label_poses
from drivesem.synth.edits import apply_edit
from drivesem.synth.frames import VARIANTS, Plan, SynthFrame, SynthSettings, build_street, plan_frame, render_frame
from drivesem.synth.layout import LayoutSettings
from scene_ir import ffd, files
from scene_ir.derender.derender import DerenderSettings, derender
from scene_ir.geometry import ground_footprint
from scene_ir.render.compositor import Compositor
from scene_ir.types import Frame, Labels, SceneIR
from tools.experiments.settings import FidelityConfig

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]
Rng = np.random.Generator

_STREETS = SynthSettings(
    LayoutSettings(variants=VARIANTS["heldout"], people=False, vehicles=(3, 7), max_heavy=1), tilt_rad=0.01
)
_STATES = 3
"""Random edits of each street."""
_EDITED, _BEYOND = 0.6, 0.25
"""Share of the vehicles that an edit changes, and of those that it moves beyond the attack's budget."""
_OWN_CAR = 0.4
"""Share of the streets with the bonnet of the camera's own car in the picture."""
_FOCAL_LOG_SIGMA, _BOX_SIGMA = 0.12, 0.015
"""Error of the focal length, as of photographs that do not state it, and of labelled boxes, in their sides."""
_DETAIL, _AROUND = 0.03, 0.1
"""Details that do not count, and surroundings that do, as shares of the object's height."""
_COMPARED_PX, _LARGEST_PX = 48.0, 400.0
"""Height at which objects are compared, and height that larger ones count as."""
_LEAST_REGION_PX = 100
"""Objects with fewer pixels before and after an edit are not measured."""
_LEAST_PX, _LEAST_VISIBLE, _LEAST_BOX_PX = 24.0, 0.3, 12.0
"""Height and visible share of vehicles that are edited, and height of labelled boxes."""
_NEAREST_M, _TOUCH_M2 = 3.0, 0.05
"""Nearest position of an edited vehicle, and area that footprints may share."""
_ATTEMPTS = 20
MIN_PRECISION = 0.8
"""Least share of rejected pictures that have a bad error, on the fitted half."""
BAD_ERROR = 0.1
"""Error of a picture that is not to be trusted."""


@dataclass(frozen=True, slots=True)
class OwnCar:
    """The bonnet of the camera's own car."""

    mask: Mask
    """(H, W), its pixels."""
    colour: Image
    """(H, W, 3), its colours."""

    @classmethod
    def draw(cls, rng: Rng, shape: tuple[int, int]) -> OwnCar:
        """A random bonnet in a picture of `shape`, without one in some."""
        y, x = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float32)
        if rng.random() >= _OWN_CAR:
            return cls(np.zeros(shape, bool), np.zeros((*shape, 3), np.float32))
        rise = rng.uniform(0.06, 0.25) * shape[0]
        across = (x / shape[1] - rng.uniform(0.4, 0.6)) / rng.uniform(0.6, 1.2)
        top = shape[0] - rise * (1 - 2 * across**2)
        shade = rng.uniform(0.05, 0.5) + 0.2 * np.clip((y - top) / max(rise, 1), 0, 1)
        tint = 1 + 0.15 * rng.standard_normal(3)
        return cls(y > top, np.clip(shade[..., None] * tint, 0, 1).astype(np.float32))

    def over(self, image: NDArray[np.uint8]) -> Image:
        """A picture (H, W, 3) in [0, 1] with the bonnet in front."""
        return np.where(self.mask[..., None], self.colour, image.astype(np.float32) / 255)


def random_edit(rng: Rng, plan: Plan, tracks: Sequence[int]) -> FrameEdit:
    """A random edit of some of the vehicles `tracks`."""
    objects = {}
    for track in tracks:
        if rng.random() >= _EDITED:
            continue
        beyond = 3.0 if rng.random() < _BEYOND else 1.0
        length = next(a.size_lhw[0] for a in plan.actors if a.track == track)
        size = float(rng.uniform(0, 1) ** 0.5)
        along = beyond * size * float(rng.uniform(-0.75, 0.75)) * length
        across = beyond * size * float(rng.uniform(-1, 1))
        mesh = tuple((0.08 * rng.standard_normal(ffd.SYMMETRIC_DIM)).tolist()) if rng.random() < 0.25 else ()
        color = tuple(rng.uniform(-0.8, 0.8, 5).tolist()) if rng.random() < 0.2 else (0.0,) * 5
        objects[track] = ObjectEdit(
            translate_m=(along, across) if rng.random() < 0.8 else (0.0, 0.0),
            rotate=beyond * size * float(rng.uniform(-0.4, 0.4)) if rng.random() < 0.7 else 0.0,
            mesh=mesh,
            color=color,
        )
    return FrameEdit(objects=objects)


def to_scene_edit(scene: SceneIR, edit: FrameEdit, frame: SynthFrame, tracks: Sequence[int]) -> FrameEdit:
    """The edit of the scene's objects that is the street's: moves are the same in camera axes."""
    own = ground_axes(scene.objects.yaw, torch.ones(len(tracks)), scene.environment.ground)
    yaws = torch.tensor([next(t.yaw for t in frame.truths if t.actor.track == track) for track in tracks])
    true = ground_axes(yaws.to(own), torch.ones(len(tracks)), scene.environment.ground)
    objects = {}
    for row, track in enumerate(tracks):
        if track in edit.objects:
            change = edit.objects[track]
            shift = torch.tensor(change.translate_m) @ true[row].float()
            moved = tuple((own[row].float() @ shift).tolist())
            objects[row] = replace(change, translate_m=moved)
    return FrameEdit(objects=objects)


def collides(scene: SceneIR, rows: Sequence[int]) -> bool:
    """Whether one of the objects `rows` stands in another, or hardly in front of the camera."""
    objects = scene.objects
    feet = ground_footprint(objects.size_lhw, objects.yaw, objects.translation).float().numpy()
    for i in rows:
        if float(objects.translation[i, 2]) < _NEAREST_M:
            return True
        for j in range(len(objects)):
            if j != i and cv2.intersectConvexConvex(feet[i], feet[j])[0] > _TOUCH_M2:
                return True
    return False


def as_frames(
    name: str, street: SynthFrame, own_car: OwnCar, rng: Rng
) -> dict[str, tuple[Frame, DerenderSettings]]:
    """The street's photograph with 3D labels, and with 2D boxes only."""
    photograph = torch.from_numpy(np.ascontiguousarray(own_car.over(street.image).transpose(2, 0, 1)))
    labels = _above_own_car(street.labels, own_car)
    exact = Frame(name, photograph, street.camera, labels)
    boxes = labels.boxes_xyxy
    sides = (boxes[:, 2:] - boxes[:, :2]).repeat(1, 2)
    noise = torch.from_numpy(rng.standard_normal(boxes.shape)).float() * _BOX_SIGMA * sides
    inside = (boxes > 1) & (boxes < torch.tensor([street.camera.width - 2, street.camera.height - 2]).repeat(2))
    boxes = boxes + noise * inside
    unknown = torch.full((), math.nan)
    flat = replace(
        labels,
        boxes_xyxy=boxes,
        translation=labels.translation * unknown,
        yaw=labels.yaw * unknown,
        size_lhw=labels.size_lhw * unknown,
    )
    factor = math.exp(_FOCAL_LOG_SIGMA * rng.standard_normal())
    intrinsics = street.camera.intrinsics.clone()
    intrinsics[:2, :2] *= factor
    projection = torch.cat([intrinsics, torch.zeros(3, 1)], dim=1)
    camera = replace(street.camera, intrinsics=intrinsics, projection=projection)
    placed = estimate_label_poses(Frame(name, photograph, camera, flat))
    return {
        "labels": (exact, DerenderSettings()),
        "boxes": (placed, DerenderSettings(fitting=FIT_TO_LABELS)),
    }


def _above_own_car(labels: Labels, own_car: OwnCar) -> Labels:
    """The labels with boxes that end where the own car begins, without those of which hardly anything is left."""
    boxes = labels.boxes_xyxy.clone()
    for i, (x0, _, x1, y1) in enumerate(boxes.tolist()):
        column = own_car.mask[:, int(min(max((x0 + x1) / 2, 0), own_car.mask.shape[1] - 1))]
        if column.any():
            boxes[i, 3] = min(y1, float(column.argmax()))
    rows = [i for i in range(len(boxes)) if float(boxes[i, 3] - boxes[i, 1]) > _LEAST_BOX_PX]
    return replace(labels, boxes_xyxy=boxes).select(rows)


def measure_error(true: Image, drawn: Image, region: Mask, height_px: float) -> float:
    """Half of 1 - SSIM of a drawn picture of an edit and the true one, in [0, 1], at a height of 48 px.

    Args:
        true: (H, W, 3) in [0, 1].
        drawn: (H, W, 3) in [0, 1].
        region: (H, W), the object before and after the edit, and around it.
        height_px: Height of the object.
    """
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    margin = int(3 * _DETAIL * height_px) + 2
    window = tuple(slice(max(int(found[0]) - margin, 0), int(found[-1]) + margin) for found in (rows, columns))
    sigma, scale = max(_DETAIL * height_px, 0.5), min(_COMPARED_PX / height_px, 1.0)

    def reduce(picture: Image) -> Image:
        smooth = cv2.GaussianBlur(np.ascontiguousarray(picture[window]), (0, 0), sigma)
        small = cv2.resize(smooth.mean(axis=2), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        return np.asarray(small, np.float32)

    one, two = reduce(true), reduce(drawn)
    inside = cv2.resize(region[window].astype(np.float32), one.shape[::-1], interpolation=cv2.INTER_AREA) > 0.5
    return float(1 - _structural_similarity(one, two)[inside].mean()) / 2 if inside.any() else 0.0


def _structural_similarity(one: Image, two: Image) -> NDArray[np.floating]:
    """SSIM (h, w) of two luminances, after Wang et al. (2004)."""

    def mean(values: NDArray[np.floating]) -> Image:
        return np.asarray(cv2.GaussianBlur(values, (0, 0), 1.5), np.float32)

    mean_one, mean_two = mean(one), mean(two)
    variances = mean(one * one) - mean_one**2 + mean(two * two) - mean_two**2
    covariance = mean(one * two) - mean_one * mean_two
    contrast = (2 * covariance + 9e-4) / (variances + 9e-4)
    return (2 * mean_one * mean_two + 1e-4) / (mean_one**2 + mean_two**2 + 1e-4) * contrast


def measure_street(seed: int, index: int) -> list[dict[str, Any]]:
    """Evidence about the edited objects of one street, and the errors of their pictures."""
    plan = plan_frame(seed, index, "heldout", _STREETS)
    surround = build_street(plan)
    street = render_frame(plan, surround=surround)
    assert street is not None
    rng = np.random.default_rng([0xF1DE, seed, index])
    own_car = OwnCar.draw(rng, street.depth_m.shape)
    labelled = [t for t in street.truths if t.labelled]
    frames = as_frames(f"street-{index}", street, own_car, rng)
    rows_left = _rows_above(street.labels, own_car)
    large = [
        labelled[i].actor.track
        for i in rows_left
        if labelled[i].box_xyxy[3] - labelled[i].box_xyxy[1] >= _LEAST_PX and labelled[i].visible > _LEAST_VISIBLE
    ]
    if not large:
        return []
    scenes: dict[str, _DerenderedStreet] = {}
    for variant, (frame, settings) in frames.items():
        scene = derender(frame, settings)
        if len(scene.objects):
            labels = [int(scene.provenance[f"objects[{i}].label"]) for i in range(len(scene.objects))]
            tracks = [labelled[rows_left[label]].actor.track for label in labels]
            scenes[variant] = _DerenderedStreet(scene, Compositor(scene), tracks)
    rows: list[dict[str, Any]] = []
    for state in range(_STATES):
        edit = _possible_edit(rng, plan, large, street, scenes)
        if edit is None:
            continue
        after = render_frame(apply_edit(plan, edit), surround=surround)
        assert after is not None
        for variant, one in scenes.items():
            errors = one.measure(edit, (street, after), own_car)
            rows += [{"street": index, "state": state, "placed_by": variant} | row for row in errors]
    return rows


@dataclass(frozen=True, slots=True)
class _DerenderedStreet:
    """A de-rendered street."""

    scene: SceneIR
    """The scene."""
    compositor: Compositor
    """Its compositor."""
    tracks: list[int]
    """Track of each object."""

    def edit(self, edit: FrameEdit, street: SynthFrame) -> SceneIR:
        """Apply an edit of the street to the scene."""
        return apply_changes(self.scene, to_scene_edit(self.scene, edit, street, self.tracks))

    def measure(
        self, edit: FrameEdit, states: tuple[SynthFrame, SynthFrame], own_car: OwnCar
    ) -> list[dict[str, Any]]:
        """Measure the evidence and error of each edited object. states: the street before and after the edit."""
        before, after = states
        true, changed = own_car.over(after.image), self.edit(edit, before)
        rest, render = self.compositor.render(self.scene), self.compositor.render(changed)
        drawn = np.ascontiguousarray(render.image.numpy().transpose(1, 2, 0))
        rows = []
        for found in measure_fidelity(self.compositor, changed):
            fidelity, (_, top, _, bottom) = found.fidelity, found.boxes_xyxy[0]
            track = self.tracks[fidelity.index]
            if track not in edit.objects:
                continue
            true_pixels = (before.instance == track + 1) | (after.instance == track + 1)
            drawn_pixels = [one.object_id.numpy() == fidelity.index + 1 for one in (render, rest)]
            region = (true_pixels & ~own_car.mask) | drawn_pixels[0] | drawn_pixels[1]
            if region.sum() < _LEAST_REGION_PX:
                continue
            height_px = min(bottom - top, _LARGEST_PX)
            reach = 2 * max(1, round(_AROUND * height_px)) + 1
            region = cv2.dilate(region.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
            error = measure_error(true, drawn, region, height_px)
            evidence = {name: getattr(fidelity, name) for name in ERROR_WEIGHTS}
            rows.append({"object": fidelity.index, "error": round(error, 5)} | evidence)
        return rows


def _possible_edit(
    rng: Rng, plan: Plan, tracks: Sequence[int], street: SynthFrame, scenes: Mapping[str, _DerenderedStreet]
) -> FrameEdit | None:
    """A random edit of vehicles `tracks` after which none stands in another; None after too many attempts."""
    for _ in range(_ATTEMPTS):
        edit = random_edit(rng, plan, tracks)
        if not edit.objects:
            continue
        moved = {v: [r for r, t in enumerate(one.tracks) if t in edit.objects] for v, one in scenes.items()}
        if not any(collides(one.edit(edit, street), moved[v]) for v, one in scenes.items()):
            return edit
    return None


def _rows_above(labels: Labels, own_car: OwnCar) -> list[int]:
    """Rows of the labels that `_above_own_car` leaves."""
    named = replace(labels, kind=tuple(str(i) for i in range(len(labels.kind))))
    return [int(name) for name in _above_own_car(named, own_car).kind]


def fit_weights(rows: Sequence[Mapping[str, Any]]) -> Floats:
    """Weights (1 + K,) of at least 0: the error of every edit, then per unit of each piece of evidence.

    Least squares of relative errors, so that good pictures count as much as bad ones.
    """
    evidence, error = _arrays(rows)
    scale = 1 / np.maximum(error, np.median(error) / 2)
    weights, _ = nnls(evidence * scale[:, None], error * scale)
    return weights


def _arrays(rows: Sequence[Mapping[str, Any]]) -> tuple[Floats, Floats]:
    """Evidence (R, 1 + K), ones first, and errors (R,)."""
    evidence = np.array([[1.0, *(row[name] for name in ERROR_WEIGHTS)] for row in rows])
    return evidence, np.array([row["error"] for row in rows])


def rank_correlation(rows: Sequence[Mapping[str, Any]], weights: Floats) -> float:
    """Spearman's correlation of predicted and true errors."""
    evidence, error = _arrays(rows)
    return float(np.corrcoef(rankdata(evidence @ weights), rankdata(error))[0, 1])


def choose_threshold(rows: Sequence[Mapping[str, Any]], weights: Floats) -> float:
    """The predicted error above which pictures are rejected: the lowest at which MIN_PRECISION of the rejected ones
    have an error above BAD_ERROR, as a rejection takes a grade away.
    """
    evidence, error = _arrays(rows)
    predicted, bad = evidence @ weights, error > BAD_ERROR
    for threshold in np.unique(np.round(predicted, 3)):
        rejected = predicted > threshold
        if rejected.any() and bad[rejected].mean() >= MIN_PRECISION:
            return float(threshold)
    return float(predicted.max())


def run_fidelity(config: FidelityConfig) -> AnalysisReport:
    """Measure streets, fit the weights to every other one, and test them on the rest."""
    out = Path(config.out)
    rows = collect_rows(out, config.streets, config.seed)
    fitted, held_out = ([row for row in rows if row["street"] % 2 == half] for half in (0, 1))
    weights = fit_weights(fitted)
    threshold = choose_threshold(fitted, weights)
    found = rank_correlation(held_out, weights)
    low, high = _bootstrap(held_out, weights, DRAWS if config.bootstrap is None else config.bootstrap, config.seed)
    evidence, error = _arrays(held_out)
    predicted, bad = evidence @ weights, error > BAD_ERROR
    rejected = predicted > threshold
    both = int((bad & rejected).sum())
    names = ("error of every edit", *ERROR_WEIGHTS)
    data = {
        "streets": config.streets,
        "objects": {"fitted": len(fitted), "held_out": len(held_out)},
        "weights": dict(zip(names, weights.round(4).tolist(), strict=True)),
        "rank_correlation": {"held_out": round(found, 4), "interval": [low, high]},
        "threshold": {"error": threshold, "fidelity": round(math.exp(-threshold / ERROR_SCALE), 4)},
        "bad_error": BAD_ERROR,
        "held_out": {"bad": int(bad.sum()), "rejected": int(rejected.sum()), "both": both},
    }
    report = AnalysisReport(
        out=out,
        name="fidelity",
        heading="Fidelity of edited objects",
        data=data,
        csv_tables={"objects": rows},
        tables=[
            ReportTable(
                "weights",
                ("evidence", "weight"),
                tuple((n, f"{w:.4f}") for n, w in zip(names, weights, strict=True)),
            )
        ],
        notes=[
            f"Rank correlation of predicted and true error on held-out streets: {found:.2f} "
            f"[{low}, {high}], {len(held_out)} edited objects.",
            f"Rejected below a fidelity of {math.exp(-threshold / ERROR_SCALE):.2f}: {rejected.sum()} of "
            f"{len(held_out)}; {both} of them, and of all {bad.sum()} such pictures, have an error above {BAD_ERROR}.",
        ],
        picture=lambda path: write_scatter(
            path,
            "Held-out streets",
            predicted.tolist(),
            error.tolist(),
            ("predicted error, (1 - SSIM) / 2", "true error, (1 - SSIM) / 2"),
        ),
        json_only=True,
    )
    report.write()
    return report


def _bootstrap(
    rows: Sequence[Mapping[str, Any]], weights: Floats, draws: int, seed: int
) -> tuple[float | None, float | None]:
    """The interval of 95 % of the rank correlation over draws of streets."""
    rng = np.random.default_rng(seed)
    by_street: dict[int, list[Mapping[str, Any]]] = {}
    for row in rows:
        by_street.setdefault(row["street"], []).append(row)
    streets = list(by_street)
    values = [
        rank_correlation(
            [row for i in rng.integers(len(streets), size=len(streets)) for row in by_street[streets[i]]], weights
        )
        for _ in range(draws)
    ]
    if not values:
        return None, None
    low, high = np.quantile(values, [0.025, 0.975])
    return round(float(low), 3), round(float(high), 3)


def collect_rows(out: Path, streets: int, seed: int) -> list[dict[str, Any]]:
    """Measure streets, or read what an earlier call measured."""
    rows = []
    for index in range(streets):
        path = out / "streets" / f"{seed}-{index:04d}.json"
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            files.write_json(path, measure_street(seed, index))
        rows += files.read_json(path)
    return rows
