"""Embedded drives: clips of one synthetic street as exact scenes; a vehicle is the same in all frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from drivesem.synth.demo import take_apart
from drivesem.synth.frames import VARIANTS, Plan, SynthFrame, SynthSettings, boxes_alone, plan_frame, render_frame
from drivesem.synth.layout import LayoutSettings
from scene_ir.errors import RangeError
from scene_ir.types import SceneIR

_KINDS = ("residential", "city")
"""Of roads: with parked rows that the camera's car goes past."""
_LAYOUT = LayoutSettings(variants=VARIANTS["heldout"], people=False, vehicles=(10, 18), max_heavy=1, kinds=_KINDS)
_ATTEMPTS = 60
_CHECKED_FRAMES = 5
"""Frames, evenly spread, by which a drive is chosen."""
_CLEAR_HEIGHT_PX, _CLEAR_VISIBLE = 30.0, 0.6
_FEWEST, _MOST = 4, 8
"""Vehicles of a drive: such as are plainly seen in one of those frames."""
_LEAST_SPEED_MPS = 4.0
_LENS_PX = 3
"""How far the lens spreads a vehicle's outline."""


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive as it is planned. tracks: of the vehicles that stand in it, in all of its frames or none."""

    seed: int
    frames: int
    attempt: int
    tracks: tuple[int, ...]

    def plan(self, number: int) -> Plan:
        """What frame `number` will show. RangeError for one that the drive has not."""
        if not 0 <= number < self.frames:
            raise RangeError("frame of the drive", f"0 to {self.frames - 1}", number)
        plan = _plan(self.seed, self.frames, number, self.attempt)
        return replace(plan, actors=tuple(actor for actor in plan.actors if actor.track in self.tracks))

    def scene(self, number: int) -> SceneIR:
        """Scene of frame `number`; `tracks` of its provenance names the vehicles in the objects' order."""
        frame = render_frame(self.plan(number), with_background=True)
        assert frame is not None
        scene = take_apart(_without_hidden(frame), f"drive-{number:03d}")
        tracks = {"tracks": ",".join(str(t.actor.track) for t in frame.truths if t.labelled)}
        labels = {f"objects[{i}].label": str(i) for i in range(len(scene.objects))}
        return replace(scene, provenance=dict(scene.provenance) | tracks | labels)


def make_drive(seed: int, frames: int) -> Drive:
    """Return the embedded drive of `frames` frames, ten a second: the seed's first with enough near vehicles.

    Raises RangeError for no frame.
    """
    if frames < 1:
        raise RangeError("frames of a drive", "at least 1", frames)
    checked_frames = sorted(
        {round(i * (frames - 1) / max(_CHECKED_FRAMES - 1, 1)) for i in range(_CHECKED_FRAMES)}
    )
    for attempt in range(_ATTEMPTS):
        if _plan(seed, frames, 0, attempt).setting.road.ego_speed_mps < _LEAST_SPEED_MPS:
            continue
        height: dict[int, float] = {}
        for number in checked_frames:
            for truth in boxes_alone(_plan(seed, frames, number, attempt)):
                tall = float(truth.box_xyxy[3] - truth.box_xyxy[1])
                if tall >= _CLEAR_HEIGHT_PX and truth.visible >= _CLEAR_VISIBLE and truth.truncation < 0.3:
                    height[truth.actor.track] = max(height.get(truth.actor.track, 0.0), tall)
        if len(height) >= _FEWEST:
            chosen = sorted(height, key=lambda track: (-height[track], track))[:_MOST]
            return Drive(seed, frames, attempt, tuple(sorted(chosen)))
    raise RangeError(f"drive of seed {seed}", f"a street within {_ATTEMPTS} attempts", "none")


def _plan(seed: int, frames: int, number: int, attempt: int) -> Plan:
    settings = SynthSettings(_LAYOUT, sunny=True, tilt_rad=0.004, sequence=frames)
    return plan_frame(seed, number, "heldout", settings, attempt)


def _without_hidden(frame: SynthFrame) -> SynthFrame:
    """The frame with objects for the labelled vehicles alone: of others, hardly seen or cut by the camera's plane,
    what shows stays in the background.
    """
    labelled = tuple(truth for truth in frame.truths if truth.labelled)
    others = (frame.owner > 0) & ~np.isin(frame.owner, [truth.index + 1 for truth in labelled])
    if not others.any():
        return replace(frame, truths=labelled)
    height, width = frame.camera.height, frame.camera.width
    uncovered = np.asarray(others.reshape(height, 2, width, 2).any(axis=(1, 3)), np.uint8)
    uncovered = cv2.dilate(uncovered, np.ones((2 * _LENS_PX + 1,) * 2, np.uint8)).astype(bool)
    assert frame.background is not None
    background = np.where(uncovered[..., None], frame.image, frame.background)
    return replace(frame, truths=labelled, background=background)
