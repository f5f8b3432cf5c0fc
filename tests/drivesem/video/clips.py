"""A clip of a small street: a camera that goes past parked cars, each of which is the same in all frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from drivesem.video.clips import DerenderedClip
from scene_ir.render.sources import photograph_scene
from scene_ir.types import SceneIR

PLACES = {4: (-2.5, 16.0), 7: (2.7, 22.0), 9: (-2.6, 34.0)}
"""Where tracks stand at first, x and z in m."""
STEP_M = 0.8
"""By which the camera comes nearer each frame."""


def clip_of(
    street: Callable[..., SceneIR], frames: int, drawn: bool = False, without: int | None = None
) -> DerenderedClip:
    """drawn: with pictures, else grey all over. without: a frame that the last car is not in."""
    scenes, tracks = [], []
    for frame in range(frames):
        there = [track for track in PLACES if not (frame == without and track == 9)]
        scene = street([(PLACES[t][0], PLACES[t][1] - STEP_M * frame) for t in there])
        message = {"tracks": ",".join(map(str, there))} | {
            f"objects[{i}].label": str(i) for i in range(len(there))
        }
        scene = replace(scene, provenance=message)
        scenes.append(photograph_scene(scene) if drawn else scene)
        tracks.append(tuple(there))
    return DerenderedClip("street", tuple(f"{f:03d}" for f in range(frames)), tuple(scenes), tuple(tracks))
