"""One interactive scene: its states rendered, evaluated by a detector, and seen from above.

Picture and detections of a state are separate calls, so the picture does not wait for the detector.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from detectors import boxes
from detectors.base import Predictor, detector_device
from detectors.types import CLASSES, Detections, Targets
from drivesem.attacks.budgets import PRESETS, STREET, change_limits
from drivesem.attacks.feasibility_check import check_places
from drivesem.attacks.objective import Objective, RenderEvaluation
from drivesem.attacks.space import Budget
from drivesem.config.commands import AttackConfig
from drivesem.evaluation import failures
from drivesem.reporting.tables import format_count
from drivesem.viewer.sliders import SceneSliders, State
from scene_ir.io import load_scene, round_to_8bit, to_uint8
from scene_ir.render.compositor import Compositor
from scene_ir.types import Category, Render, SceneIR, convert_scene

QUALITY = 92
"""JPEG quality."""
_MAX_RENDERS, _MAX_SCORES = 4, 4096
_MARGIN_M = 8.0
"""Street around the vehicles in the view from above."""
_LEAST_WIDTH_M, _NEAREST_M, _FARTHEST_M = 20.0, 3.0, 90.0
_PIXELS_PER_M = 12
_OFF_ROAD = 0.3
"""Opacity of ground that is not road."""
_NAMED = {"missed": "missed as photographed too", "ignored": "not judged"}


@dataclass(frozen=True, slots=True)
class RenderedState:
    """A rendered state."""

    scene: SceneIR
    """The scene in this state."""
    render: Render
    """Its picture."""


class InteractiveScene:
    """A scene that can be rendered and evaluated in any state of its sliders.

    Rendering and detecting may run in one thread each; otherwise it is not thread-safe.
    """

    @torch.no_grad()
    def __init__(self, folder: Path, detector: Predictor, budget: Budget, t_star: float | None) -> None:
        """Load a scene.

        Args:
            folder: Folder of the scene.
            detector: Detector that evaluates it.
            budget: Range of the sliders.
            t_star: Score from which a detection counts; None: the detector's own.

        Raises SceneError for an unreadable folder, DetectorError for a detector without the class Car.
        """
        self.folder = folder
        self.sliders = SceneSliders(convert_scene(load_scene(folder), None, detector_device(detector)), budget)
        space = self.sliders.space
        self.objective = Objective(Compositor(self.sliders.rest), space, detector, AttackConfig(t_star=t_star))
        benign = self.objective.benign
        targets = self.objective.classes.map_targets(benign.paper.targets)
        self._found = failures.match_detections(targets, benign.detections, self.objective.t_star).detected
        self._renders: OrderedDict[tuple[tuple[str, float], ...], RenderedState] = OrderedDict()
        self._scores: OrderedDict[tuple[int, tuple[tuple[str, float], ...]], dict[str, Any]] = OrderedDict()
        self._picture: bytes | None = None
        self.focus = self._focus()

    def render_state(self, state: State, keep: bool = True) -> RenderedState:
        """Render a state, or return the cached render. keep: cache it."""
        key = tuple(sorted(state.items()))
        known = self._renders.get(key)
        if known is not None:
            return known
        with torch.no_grad():
            scene = self.sliders.apply(state)
            known = RenderedState(scene, self.objective.compositor.render(scene))
        if keep:
            self._renders[key] = known
            while len(self._renders) > _MAX_RENDERS:
                self._renders.popitem(last=False)
        return known

    @torch.no_grad()
    def detect(self, state: State, rendered: RenderedState) -> dict[str, Any]:
        """Boxes to draw, status of each vehicle, and the state's command, as JSON values."""
        evaluation = self._evaluate(state, rendered)
        failed = self.objective.failures(evaluation, "moved")
        cars = self._car_statuses(evaluation)
        phrases = [format_count(len(failed.lost), "object lost", "objects lost") if failed.lost else ""]
        phrases += [format_count(len(failed.phantoms), "phantom", "phantoms") if failed.phantoms else ""]
        return {
            "boxes": self._boxes(evaluation, cars, failed.phantoms),
            "cars": cars,
            "lost": len(failed.lost),
            "phantoms": len(failed.phantoms),
            "words": ", ".join(filter(None, phrases)) or "nothing lost, no phantom",
            "command": self.sliders.command(self.folder.resolve(), state),
        }

    def known_score(self, state: State, car: int) -> dict[str, Any] | None:
        """Cached result of `score`."""
        return self._scores.get((car, tuple(sorted(state.items()))))

    @torch.no_grad()
    def score(self, state: State, car: int, rendered: RenderedState) -> dict[str, Any]:
        """Status and score of one vehicle in a state, as JSON values.

        Args:
            state: Slider values.
            car: Row of the vehicle.
            rendered: The rendered state.
        """
        result = self._car_statuses(self._evaluate(state, rendered))[car]
        self._scores[(car, tuple(sorted(state.items())))] = result
        while len(self._scores) > _MAX_SCORES:
            self._scores.popitem(last=False)
        return result

    def notes(self, rendered: RenderedState) -> list[str]:
        """Violated constraints: vehicles off the ground or the road, out of the picture, or inside one another."""
        rest = self.sliders.rest
        there = (row for row in range(len(rest.objects)) if float(rest.objects.translation[row, 2]) > 0)
        return check_places(rest, rendered.scene, there, change_limits(PRESETS[STREET]))

    def encode_picture(self, rendered: RenderedState) -> bytes:
        """JPEG of a rendered state."""
        return _encode_jpeg(to_uint8(rendered.render.image))

    def encode_photograph(self) -> bytes:
        """JPEG of the photograph."""
        if self._picture is None:
            self._picture = _encode_jpeg(to_uint8(self.sliders.rest.photograph))
        return self._picture

    def facts(self) -> dict[str, Any]:
        """Everything that a page needs to display the photograph, as JSON values."""
        rest, objects = self.sliders.rest, self.sliders.rest.objects
        benign = self.objective.benign
        statuses = self._car_statuses(benign)
        cars = [
            {
                "car": row,
                "class": Category(int(objects.category[row])).name.lower(),
                "x": float(objects.translation[row, 0]),
                "z": float(objects.translation[row, 2]),
                "yaw": float(objects.yaw[row]),
                "length": float(objects.size_lhw[row, 0]),
                "width": float(objects.size_lhw[row, 2]),
                **statuses[row],
            }
            for row in range(len(objects))
        ]
        return {
            "height": rest.camera.height,
            "width": rest.camera.width,
            "t_star": self.objective.t_star,
            "sliders": [
                {name: getattr(slider, name) for name in slider.__slots__}
                for slider in self.sliders.sliders.values()
            ],
            "found": self.sliders.found,
            "focus": self.focus,
            "cars": cars,
            "boxes": self._boxes(benign, statuses),
            "street": dict(zip(("x0", "x1", "z0", "z1"), self.street_m(), strict=True)),
            "change": rest.provenance.get("change", ""),
        }

    def street_m(self) -> tuple[float, float, float, float]:
        """Extent of the view from above, (x0, x1, z0, z1) m in camera axes."""
        place = self.sliders.rest.objects.translation
        place = place[place[:, 2] > 0]
        x, z = (place[:, i].tolist() or [0.0] for i in (0, 2))
        far = min(max(max(z) + _MARGIN_M, 25.0), _FARTHEST_M)
        half = max(_LEAST_WIDTH_M / 2, *(abs(v) + _MARGIN_M for v in x))
        return (-half, half, _NEAREST_M, far)

    def encode_street(self) -> bytes:
        """PNG of the ground from above, far is up.

        Ground outside the photograph is transparent. Ground that is not road is pale, because what stands there is
        smeared over it.
        """
        x0, x1, z0, z1 = self.street_m()
        rest = convert_scene(self.sliders.rest, None, "cpu")
        columns, rows = (max(round((b - a) * _PIXELS_PER_M), 1) for a, b in ((x0, x1), (z0, z1)))
        x, z = np.meshgrid(
            x0 + (np.arange(columns) + 0.5) / _PIXELS_PER_M, z1 - (np.arange(rows) + 0.5) / _PIXELS_PER_M
        )
        normal = rest.environment.ground.double().numpy()
        y = -(normal[0] * x + normal[2] * z + normal[3]) / normal[1]
        ground = np.stack([x, y, z, np.ones_like(x)], -1) @ rest.camera.matrix.double().numpy().T
        u, v = (ground[..., i] / ground[..., 2] for i in (0, 1))
        inside = (u >= 0) & (u <= rest.camera.width - 1) & (v >= 0) & (v <= rest.camera.height - 1)
        lookup = (u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
        above = cv2.remap(to_uint8(rest.background), *lookup)
        road = cv2.remap(rest.environment.road.float().numpy(), *lookup)
        shows = np.where(inside, _OFF_ROAD + (1 - _OFF_ROAD) * road, 0.0)
        rgba = np.dstack([above[..., ::-1], 255 * shows]).round().astype(np.uint8)
        return _encode(".png", rgba)

    def _focus(self) -> int:
        """Row of the vehicle selected first: a lost one in the scene's own state, else the nearest judged one."""
        found = self.sliders.found
        cars = self._car_statuses(self._evaluate(found, self.render_state(found)))
        far = self.sliders.rest.objects.translation[:, 2].tolist()
        order = {"lost": 0, "found": 1, "missed": 2, "ignored": 3}
        rows = (row for row in range(len(cars)) if far[row] > 0)
        return min(rows, key=lambda row: (order[cars[row]["status"]], far[row]), default=0)

    def _evaluate(self, state: State, rendered: RenderedState) -> RenderEvaluation:
        if not state and self.sliders.rest.before is None:
            return self.objective.benign
        return self.objective.evaluate_render(rendered.scene, self._restrict_to_changes(rendered.render))

    def _restrict_to_changes(self, render: Render) -> Render:
        """Limit the render's regions to those that differ from the benign render, for incremental inference."""
        if render.vehicle_regions is None:
            return render
        before = self.objective.benign.render.image
        rows = []
        for row, (x0, y0, x1, y1) in enumerate(render.vehicle_regions.tolist()):
            if not torch.equal(round_to_8bit(render.image[:, y0:y1, x0:x1]), before[:, y0:y1, x0:x1]):
                rows.append(row)
        return replace(render, vehicle_regions=render.vehicle_regions[rows])

    def _car_statuses(self, rendered: RenderEvaluation) -> list[dict[str, Any]]:
        """Status of each vehicle (found, lost, missed in the photograph too, ignored) and its best matching score."""
        targets = self.objective.classes.map_targets(rendered.moved.targets)
        judged = failures.match_detections(targets, rendered.detections, self.objective.t_star)
        statuses = []
        for row in range(len(self.sliders.rest.objects)):
            if bool(targets.ignore[row]):
                status = "ignored"
            elif bool(judged.detected[row]):
                status = "found"
            else:
                status = "lost" if bool(self._found[row]) else "missed"
            statuses.append({"status": status, "score": best_score(targets, rendered.detections, row)})
        return statuses

    def _boxes(
        self, rendered: RenderEvaluation, cars: list[dict[str, Any]], phantoms: Collection[int] = ()
    ) -> list[dict[str, Any]]:
        """True boxes, then detections with a score of at least t*."""
        marks: list[dict[str, Any]] = []
        moved, detections, names = rendered.moved, rendered.detections, self.objective.classes.names
        for row, box in enumerate(moved.boxes_xyxy.tolist()):
            if not bool(moved.in_view[row]):
                continue
            name, status = CLASSES[int(moved.category[row])], cars[row]["status"]
            kind = status if status in ("lost", "ignored") else "true"
            text = f"{row}: {name}, {_NAMED.get(status, status)}"
            marks.append({"kind": kind, "xyxy": box, "text": text, "car": row})
        parts = (detections.boxes_xyxy, detections.labels, detections.scores)
        rows = zip(*(part.tolist() for part in parts), strict=True)
        for i, (box, label, score) in enumerate(rows):
            if score >= self.objective.t_star:
                kind = "phantom" if i in phantoms else "found"
                text = f"{'phantom ' if kind == 'phantom' else ''}{names[label]} {score:.2f}"
                marks.append({"kind": kind, "xyxy": box, "text": text, "car": None})
        return marks


def best_score(targets: Targets, detections: Detections, row: int) -> float:
    """Best score of a detection that matches a target; 0 without one.

    Args:
        targets: Targets (M,).
        detections: Detections (N,).
        row: Row of the target.
    """
    overlap = boxes.iou_matrix(detections.boxes_xyxy, targets.boxes_xyxy[row : row + 1])[:, 0]
    meets = (overlap >= failures.MATCH_IOU) & (detections.labels == targets.labels[row])
    return float(detections.scores[meets].max()) if bool(meets.any()) else 0.0


def _encode_jpeg(picture: NDArray[np.uint8]) -> bytes:
    return _encode(".jpg", picture[..., ::-1], cv2.IMWRITE_JPEG_QUALITY, QUALITY)


def _encode(suffix: str, picture: NDArray[np.uint8], *how: int) -> bytes:
    _, encoded = cv2.imencode(suffix, picture, how)
    return encoded.tobytes()
