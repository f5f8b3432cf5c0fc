"""One scene made ready to be moved: drawn, looked at by a detector, and seen from above.

A picture and what a detector finds in it are asked for one after the other, so that the picture need not wait.
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
from detectors.base import Predictor, device_of
from detectors.types import CLASSES, Detections, Targets
from drivesem.attack.feasibility_check import check_places
from drivesem.attack.objective import Objective, Rendered
from drivesem.attack.space import Budget
from drivesem.evaluation import failures
from drivesem.report.tables import number_of
from drivesem.viewer.knobs import Knobs, State
from scene_ir.io import as_written, load_scene, to_uint8
from scene_ir.render.compositor import Compositor
from scene_ir.types import Category, Render, SceneIR, scene_to

QUALITY = 92
"""Of JPEG files."""
_KEPT_DRAWINGS, _KEPT_SCORES = 4, 4096
_MARGIN_M = 8.0
"""Of the street around the vehicles, as seen from above."""
_LEAST_WIDTH_M, _NEAREST_M, _FARTHEST_M = 20.0, 3.0, 90.0
_PIXELS_PER_M = 12
_OFF_ROAD = 0.3
"""How much shows of what is not road."""
_NAMED = {"missed": "missed as photographed too", "ignored": "not judged"}


@dataclass(frozen=True, slots=True)
class Drawn:
    """A state, drawn."""

    scene: SceneIR
    render: Render


class Stage:
    """A scene's folder, made ready. Raises SceneError where it cannot be read, DetectorError where the detector
    knows no cars. t_star: by default the detector's own.

    Not for several threads at once, but that drawing and looking may each have its own.
    """

    @torch.no_grad()
    def __init__(self, folder: Path, detector: Predictor, budget: Budget, t_star: float | None) -> None:
        self.folder = folder
        self.knobs = Knobs(scene_to(load_scene(folder), None, device_of(detector)), budget)
        space = self.knobs.space
        self.objective = Objective(Compositor(self.knobs.rest), space, detector, t_star=t_star)
        benign = self.objective.benign
        targets = self.objective.judged.targets(benign.paper.targets)
        self._found = failures.judge(targets, benign.detections, self.objective.t_star).found
        self._drawn: OrderedDict[tuple[tuple[str, float], ...], Drawn] = OrderedDict()
        self._scores: OrderedDict[tuple[int, tuple[tuple[str, float], ...]], dict[str, Any]] = OrderedDict()
        self._picture: bytes | None = None
        self.focus = self._focus()

    def drawn(self, state: State, keep: bool = True) -> Drawn:
        """The scene in a state, drawn or as it was drawn before. keep: for the next question about it."""
        key = tuple(sorted(state.items()))
        known = self._drawn.get(key)
        if known is not None:
            return known
        with torch.no_grad():
            scene = self.knobs.apply(state)
            known = Drawn(scene, self.objective.compositor.render(scene))
        if keep:
            self._drawn[key] = known
            while len(self._drawn) > _KEPT_DRAWINGS:
                self._drawn.popitem(last=False)
        return known

    @torch.no_grad()
    def seen(self, state: State, drawn: Drawn) -> dict[str, Any]:
        """What the detector finds: boxes to draw, a line on each vehicle, the state's command; for JSON."""
        rendered = self._look(state, drawn)
        failed = self.objective.failures(rendered, "moved")
        cars = self._cars(rendered)
        said = [number_of(len(failed.lost), "object lost", "objects lost") if failed.lost else ""]
        said += [number_of(len(failed.phantoms), "phantom", "phantoms") if failed.phantoms else ""]
        return {
            "boxes": self._boxes(rendered, cars, failed.phantoms),
            "cars": cars,
            "lost": len(failed.lost),
            "phantoms": len(failed.phantoms),
            "words": ", ".join(filter(None, said)) or "nothing lost, no phantom",
            "command": self.knobs.command(self.folder.resolve(), state),
        }

    def known_score(self, state: State, car: int) -> dict[str, Any] | None:
        """What `score` said of the same before."""
        return self._scores.get((car, tuple(sorted(state.items()))))

    @torch.no_grad()
    def score(self, state: State, car: int, drawn: Drawn) -> dict[str, Any]:
        """What the detector makes of one vehicle in a state: its status and score; for JSON."""
        told = self._cars(self._look(state, drawn))[car]
        self._scores[(car, tuple(sorted(state.items())))] = told
        while len(self._scores) > _KEPT_SCORES:
            self._scores.popitem(last=False)
        return told

    def notes(self, drawn: Drawn) -> list[str]:
        """What no car can do: which left the ground or the road, or stand in one another."""
        count = len(self.knobs.rest.objects)
        there = (row for row in range(count) if float(drawn.scene.objects.translation[row, 2]) > 0)
        return check_places(self.knobs.rest, drawn.scene, there)

    def picture(self, drawn: Drawn) -> bytes:
        """A JPEG of a drawn state."""
        return _jpeg(to_uint8(drawn.render.image))

    def photograph(self) -> bytes:
        """A JPEG of the photograph."""
        if self._picture is None:
            self._picture = _jpeg(to_uint8(self.knobs.rest.photograph))
        return self._picture

    def facts(self) -> dict[str, Any]:
        """What a page needs to know before anything moves; for JSON."""
        rest, objects = self.knobs.rest, self.knobs.rest.objects
        benign = self.objective.benign
        told = self._cars(benign)
        cars = [
            {
                "car": row,
                "class": Category(int(objects.category[row])).name.lower(),
                "x": float(objects.translation[row, 0]),
                "z": float(objects.translation[row, 2]),
                "yaw": float(objects.yaw[row]),
                "length": float(objects.size_lhw[row, 0]),
                "width": float(objects.size_lhw[row, 2]),
                **told[row],
            }
            for row in range(len(objects))
        ]
        return {
            "height": rest.camera.height,
            "width": rest.camera.width,
            "t_star": self.objective.t_star,
            "knobs": [
                {name: getattr(knob, name) for name in knob.__slots__} for knob in self.knobs.knobs.values()
            ],
            "found": self.knobs.found,
            "focus": self.focus,
            "cars": cars,
            "boxes": self._boxes(benign, told),
            "street": dict(zip(("x0", "x1", "z0", "z1"), self.street_m(), strict=True)),
            "change": rest.provenance.get("change", ""),
        }

    def street_m(self) -> tuple[float, float, float, float]:
        """What is seen from above: x from left to right, z from near to far, m in camera axes."""
        place = self.knobs.rest.objects.translation
        place = place[place[:, 2] > 0]
        x, z = (place[:, i].tolist() or [0.0] for i in (0, 2))
        far = min(max(max(z) + _MARGIN_M, 25.0), _FARTHEST_M)
        half = max(_LEAST_WIDTH_M / 2, *(abs(v) + _MARGIN_M for v in x))
        return (-half, half, _NEAREST_M, far)

    def street(self) -> bytes:
        """A PNG of the ground from above, as far as the photograph shows it; far is up. Where it does not it is
        transparent, and pale where there is no road: what stands there is smeared over the ground.
        """
        x0, x1, z0, z1 = self.street_m()
        rest = scene_to(self.knobs.rest, None, "cpu")
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
        return _encoded(".png", rgba)

    def _focus(self) -> int:
        """The vehicle to begin with: the first that is lost in the state that the scene holds, else the nearest of
        those that are judged, else any.
        """
        found = self.knobs.found
        cars = self._cars(self._look(found, self.drawn(found)))
        far = self.knobs.rest.objects.translation[:, 2].tolist()
        order = {"lost": 0, "found": 1, "missed": 2, "ignored": 3}
        rows = (row for row in range(len(cars)) if far[row] > 0)
        return min(rows, key=lambda row: (order[cars[row]["status"]], far[row]), default=0)

    def _look(self, state: State, drawn: Drawn) -> Rendered:
        if not state and self.knobs.rest.before is None:
            return self.objective.benign
        return self.objective.look(drawn.scene, self._where_changed(drawn.render))

    def _where_changed(self, render: Render) -> Render:
        """A render that says where it differs from the benign one, not where vehicles are drawn: those that stand
        as photographed have the same pixels, and a detector need not look at them again.
        """
        if render.drawn is None:
            return render
        before = self.objective.benign.render.image
        rows = []
        for row, (x0, y0, x1, y1) in enumerate(render.drawn.tolist()):
            if not torch.equal(as_written(render.image[:, y0:y1, x0:x1]), before[:, y0:y1, x0:x1]):
                rows.append(row)
        return replace(render, drawn=render.drawn[rows])

    def _cars(self, rendered: Rendered) -> list[dict[str, Any]]:
        """Of each vehicle, status: found, lost, missed (as photographed too), ignored (too small or hidden to be
        judged); and the best score of what finds it.
        """
        targets = self.objective.judged.targets(rendered.moved.targets)
        judged = failures.judge(targets, rendered.detections, self.objective.t_star)
        told = []
        for row in range(len(self.knobs.rest.objects)):
            if bool(targets.ignore[row]):
                status = "ignored"
            elif bool(judged.found[row]):
                status = "found"
            else:
                status = "lost" if bool(self._found[row]) else "missed"
            told.append({"status": status, "score": best_score(targets, rendered.detections, row)})
        return told

    def _boxes(
        self, rendered: Rendered, cars: list[dict[str, Any]], phantoms: Collection[int] = ()
    ) -> list[dict[str, Any]]:
        """True boxes, then detections from t* on."""
        marks: list[dict[str, Any]] = []
        moved, detections, names = rendered.moved, rendered.detections, self.objective.judged.names
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
    """The best score of a detection that would find a target; 0 where there is none."""
    overlap = boxes.iou_matrix(detections.boxes_xyxy, targets.boxes_xyxy[row : row + 1])[:, 0]
    meets = (overlap >= failures.IOU) & (detections.labels == targets.labels[row])
    return float(detections.scores[meets].max()) if bool(meets.any()) else 0.0


def _jpeg(picture: NDArray[np.uint8]) -> bytes:
    return _encoded(".jpg", picture[..., ::-1], cv2.IMWRITE_JPEG_QUALITY, QUALITY)


def _encoded(suffix: str, picture: NDArray[np.uint8], *how: int) -> bytes:
    _, encoded = cv2.imencode(suffix, picture, how)
    return encoded.tobytes()
