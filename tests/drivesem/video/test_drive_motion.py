"""Objects do not tremble: in the pictures of a changed clip they move as their places do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from drivesem.attacks.space import ParameterSpace
from drivesem.synth.demo import make_drive
from drivesem.synth.write import Order, synthesise
from drivesem.video.clips import ClipDerenderer, ClipSource, DerenderedClip, object_tracks
from drivesem.video.objective import ClipSpace
from scene_ir.derender.silhouette import Placement
from scene_ir.geometry import to_clip
from scene_ir.render.compositor import Compositor
from scene_ir.types import SceneIR
from tests.drivesem.video.clips import clip_of

STEADY_PX = 1.0
"""What whole pixels leave, between three frames, of a car that is steady."""
NOISE_M = 0.05
"""Of places, from frame to frame: what one would see as trembling."""


class Watched:
    """A clip as it was taken, and how its pictures are drawn."""

    def __init__(self, clip: DerenderedClip) -> None:
        self.clip = clip
        self._compositors = [Compositor(scene) for scene in clip.scenes]

    def trembling_px(self, visible: Sequence[SceneIR], meant: Sequence[SceneIR], *tracks: int) -> list[float]:
        """How far the pictures of cars leave, from frame to frame, the motion of their places. shown: what is
        drawn; meant: where the cars are to be.

        The middle of the pixels that show a car is held against the middle of its projected hull. What remains
        between the two is smooth where the car is the same in all frames: its second difference is the trembling.
        """
        apart: dict[int, list[list[float]]] = {track: [] for track in tracks}
        for frame, of_frame in enumerate(self.clip.tracks):
            with torch.no_grad():
                owner = self._compositors[frame].render(visible[frame]).object_id
            for track in tracks:
                row = of_frame.index(track)
                rows, columns = (owner == row + 1).nonzero().double().unbind(1)
                x, y = middle_of_hull(meant[frame], row)
                apart[track].append([float(columns.mean()) - x, float(rows.mean()) - y])
        return [float(np.abs(np.diff(np.array(apart[track]), n=2, axis=0)).max()) for track in tracks]


def middle_of_hull(scene: SceneIR, row: int) -> tuple[float, float]:
    """The centroid, px, of the convex hull of a car's projected vertices."""
    objects = scene.objects
    mesh = scene.meshes[int(objects.mesh_index[row])]
    own = (objects.translation[row], objects.yaw[row], objects.size_lhw[row], objects.ffd[row])
    clip = to_clip(Placement(mesh, *own).vertices(), scene.camera.matrix)
    hull = cv2.convexHull((clip[:, :2] / clip[:, 2:3]).numpy().astype(np.float32))
    found = cv2.moments(hull)
    return found["m10"] / found["m00"], found["m01"] / found["m00"]


def changed(clip: DerenderedClip, noise_m: float = 0.0) -> list[SceneIR]:
    """The clip with a path aside, and each frame's places off by noise of its own."""
    spaces = [ParameterSpace(scene, ("color", "translate")) for scene in clip.scenes]
    space = ClipSpace(spaces, clip.tracks)
    generator = torch.Generator().manual_seed(3)
    theta = space.lower + torch.rand(space.dim, generator=generator) * (space.upper - space.lower)
    found = []
    for frame, one in enumerate(spaces):
        scene = one.apply(one.scene, space.frame_theta(theta, frame))
        noise = noise_m * torch.randn(scene.objects.translation.shape, generator=generator)
        found.append(
            scene.with_objects(translation=scene.objects.translation + noise * torch.tensor([1.0, 0.0, 1.0]))
        )
    return found


def test_cars_move_as_their_places_do(street: Callable[..., SceneIR]) -> None:
    clip = clip_of(street, 6, drawn=True)
    watched, meant = Watched(clip), changed(clip)
    assert max(watched.trembling_px(meant, meant, 4, 7)) < STEADY_PX
    assert min(watched.trembling_px(changed(clip, NOISE_M), meant, 4, 7)) > 3 * STEADY_PX


@pytest.mark.slow
def test_people_of_a_generated_clip_walk_as_their_places_do(tmp_path: Path) -> None:
    """Each is cut out of each frame anew; the shifted place stays on the ground, and the picture follows it."""
    assert len(list(synthesise(Order(tmp_path / "data", 4, 9, "kitti", "heldout", sequence=4)))) == 4
    source = ClipSource(str(tmp_path / "data"), None, None, 0, fit=False, keep_going=False, people=True)
    derenderer = ClipDerenderer(source, tmp_path / "scenes")
    names = derenderer.frames.names
    scenes = tuple(derenderer.frames.scene(name) for name in names)
    clip = DerenderedClip(derenderer.frames.name, names, scenes, tuple(map(object_tracks, scenes)))
    walking = [
        track
        for track in clip.tracks[0]
        if all(track in of_frame for of_frame in clip.tracks)
        and bool(scenes[0].objects.upright[clip.tracks[0].index(track)])
    ]
    assert walking
    meant = changed(clip)
    for frame, scene in enumerate(scenes):
        rows = [clip.tracks[frame].index(track) for track in walking]
        offset = (meant[frame].objects.translation - scene.objects.translation)[rows]
        assert float((offset @ scene.environment.ground[:3]).abs().max()) < 1e-5
        assert float(offset.norm(dim=1).min()) > 0.01
    assert (
        max(Watched(clip).trembling_px(meant, meant, *walking)) < 3 * STEADY_PX
    )  # limbs move, and outlines differ


@pytest.mark.slow
def test_cars_of_the_embedded_drive_move_as_their_places_do() -> None:
    drive = make_drive(0, 30)
    scenes = tuple(drive.scene(number) for number in range(5))
    clip = DerenderedClip(
        "drive", tuple(map(str, range(5))), scenes, tuple(object_tracks(scene) for scene in scenes)
    )
    watched, meant = Watched(clip), changed(clip)
    plain = (8, 20)  # in all of these frames, and hidden by nothing
    assert max(watched.trembling_px(meant, meant, *plain)) < STEADY_PX
    assert min(watched.trembling_px(changed(clip, NOISE_M), meant, *plain)) > 3 * STEADY_PX
    assert drive == make_drive(0, 30)
    assert all(set(tracks) <= set(drive.tracks) for tracks in clip.tracks)
    by_track: dict[int, set[tuple[str, tuple[float, ...]]]] = {}
    for scene, tracks in zip(scenes, clip.tracks, strict=True):
        for row, track in enumerate(tracks):
            mesh = scene.meshes[int(scene.objects.mesh_index[row])].name
            by_track.setdefault(track, set()).add((mesh, tuple(scene.objects.size_lhw[row].tolist())))
    assert all(len(crops) == 1 for crops in by_track.values())
