"""The scene generator as a second renderer: it carries a scene's change to its own plan, and draws that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from detectors.types import CLASSES, Targets
from drivesem.config.edits import FrameEdit
from drivesem.failures.second_renderer.base import Redrawn
from drivesem.failures.second_renderer.carry import Carried, carried
from drivesem.failures.second_renderer.exact import Exact, exact_labels
from drivesem.failures.second_renderer.plans import Plans
from drivesem.synth.edits import apply_edit
from drivesem.synth.frames import Plan, Street, SynthFrame, render_frame, street_of, table
from drivesem.synth.view import SUPERSAMPLING
from scene_ir.errors import FormatError
from scene_ir.types import SceneIR

_ROUNDING = 1
"""Levels of 255 by which the same picture may differ from one processor to another."""


@dataclass(frozen=True, slots=True)
class _Drawn:
    """An edit of the plan, its picture, and what stands in it besides vehicles."""

    edit: FrameEdit
    frame: SynthFrame
    surround: Street


class GeneratorRedraw:
    """The generator, for one generated frame. scene: any state of it; plans: that know it by `identifier`.

    Raises FormatError where the plan is not that of the frame, as the photograph tells.
    """

    name = "generator"

    def __init__(self, identifier: str, scene: SceneIR, plans: Plans) -> None:
        self._identifier = identifier
        self._still = scene.as_photographed()
        self._planned = plans.planned(identifier, scene)
        surround = street_of(self._planned.plan)
        frame = _rendered(self._planned.plan, surround)
        _check_same(identifier, scene.photograph, frame.image)
        self._before = self._last = _Drawn(self.carried(self._still).edit, frame, surround)

    def not_carried(self, changed: SceneIR) -> tuple[str, ...]:
        """Changes of vehicles for which the plan has no counterpart."""
        return self.carried(changed).missing

    def carried(self, changed: SceneIR) -> Carried:
        """The change as an edit of the plan, and what of it the plan has no counterpart for."""
        return carried(self._still, changed, self._planned)

    def redraw(self, changed: SceneIR) -> Redrawn:
        """A state of the scene, vehicles without a counterpart in the plan as they were photographed.

        Ignored are objects without a counterpart, and those that are too hard in either picture. Regions: what the
        generator ignores in either, and labelled vehicles that the scene does not know.
        """
        after = self.drawn(changed)
        exact = exact_labels(self._before.frame, after)
        tracks = self._planned.tracks
        return Redrawn(_picture(after.image), _of_objects(exact, tracks, changed), _shown(after, tracks))

    def drawn(self, changed: SceneIR) -> SynthFrame:
        """A state of the scene with all that the generator knows of it, its own labels of everything included."""
        return self._drawn(self.carried(changed).edit)

    def _drawn(self, edit: FrameEdit) -> SynthFrame:
        """The picture of an edit. What stands in the street is made again only where its leaves changed."""
        for known in (self._before, self._last):
            if edit == known.edit:
                return known.frame
        plan = apply_edit(self._planned.plan, edit, f"frame {self._identifier}")
        surround = self._last.surround if edit.foliage == self._last.edit.foliage else street_of(plan)
        frame = _rendered(plan, surround)
        self._last = _Drawn(edit, frame, surround)
        return frame


def _rendered(plan: Plan, surround: Street) -> SynthFrame:
    frame = render_frame(plan, surround=surround)
    assert frame is not None
    return frame


def _check_same(identifier: str, photograph: Tensor, image: np.ndarray) -> None:
    """Raises FormatError where the scene's photograph is not the picture that the generator makes."""
    expected = "the picture that the generator makes of it"
    given = np.rint(photograph.cpu().numpy().transpose(1, 2, 0) * 255).astype(np.int16)
    if given.shape != image.shape:
        raise FormatError(f"photograph of {identifier}", expected, f"one of shape {given.shape}")
    apart = int(np.abs(given - image).max(initial=0))
    if apart > _ROUNDING:
        raise FormatError(f"photograph of {identifier}", expected, f"one {apart} levels off")


def _picture(image: np.ndarray) -> Tensor:
    return torch.from_numpy(image.transpose(2, 0, 1).astype(np.float32) / np.float32(255))


def _of_objects(exact: Exact, tracks: tuple[int | None, ...], scene: SceneIR) -> Targets:
    """The changed picture's labels: rows of the scene's objects, then regions, each once for each class."""
    rows = {track: row for row, track in enumerate(exact.tracks)}
    own = [rows.get(track) if track is not None else None for track in tracks]
    boxes = scene.objects.box2d.new_zeros(len(tracks), 4, device="cpu", dtype=torch.float32)
    labels = scene.objects.category.cpu().clone()
    ignore = torch.ones(len(tracks), dtype=torch.bool)
    for i, row in enumerate(own):
        if row is not None:
            boxes[i], labels[i] = exact.changed.boxes_xyxy[row], exact.changed.labels[row]
            ignore[i] = exact.changed.ignore[row]
    strange = [row for row in rows.values() if row not in own]
    around = exact.changed.boxes_xyxy[strange].repeat_interleave(len(CLASSES), dim=0)
    kinds = torch.arange(len(CLASSES)).repeat(len(strange))
    regions = slice(len(rows), None)
    return Targets(
        torch.cat([boxes, around, exact.changed.boxes_xyxy[regions]]),
        torch.cat([labels, kinds, exact.changed.labels[regions]]),
        torch.cat([ignore, torch.ones_like(kinds, dtype=torch.bool), exact.changed.ignore[regions]]),
    )


def _shown(frame: SynthFrame, tracks: tuple[int | None, ...]) -> Tensor:
    """Boxes (N, 4) px of what the picture shows of each object; see `synth.frames.measure` for the pixels."""
    n, camera = SUPERSAMPLING, frame.camera
    limit = [camera.width - 1, camera.height - 1] * 2
    owners = {t.actor.track: t.index + 1 for t in frame.truths}
    boxes = []
    for track in tracks:
        seen = frame.owner == owners[track] if track in owners else np.zeros((1, 1), bool)
        rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        if len(rows):
            edges = np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]) / n - 0.5
            boxes.append(np.clip(edges, 0, limit))
        else:
            boxes.append(np.zeros(4))
    return table(boxes, 4)
