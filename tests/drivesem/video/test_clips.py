"""A clip of which a picture is damaged: the others are taken apart alike, whichever comes first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from drivesem.data.subsets import Clip
from drivesem.video import clips as taking
from drivesem.video.clips import ClipDerenderer, ClipSource, background_people, object_tracks
from scene_ir.derender.derender import DerenderSettings
from scene_ir.derender.silhouette import Placement, place_mesh
from scene_ir.errors import FormatError
from scene_ir.types import Camera, Frame, Labels, SceneIR

NAMES = ("a", "b", "c")
TRACKS = (4, 7)
HEIGHTS = {"a": (20, 30), "b": (60, 60), "c": (40, 10)}
"""Of both cars: b shows both best, then c the first and a the second."""
MESHES = {"a": "sedan", "b": "van", "c": "suv"}
"""What a car is taken for in each frame."""
SIZE = torch.tensor([4.2, 1.5, 1.8])


class Drive:
    """The frames, of which the pictures of some cannot be read."""

    identifiers = NAMES

    def __init__(self, *damaged: str) -> None:
        self._damaged = damaged

    def labels(self, identifier: str) -> Labels:
        """Two cars."""
        return Labels(
            kind=("Car", "Car"),
            boxes_xyxy=torch.tensor([[0.0, 0.0, 50.0, float(height)] for height in HEIGHTS[identifier]]),
            truncation=torch.zeros(2),
            occlusion=torch.zeros(2, dtype=torch.int64),
            translation=torch.tensor([[-2.0, 1.6, 15.0], [3.0, 1.6, 20.0]]),
            yaw=torch.zeros(2),
            size_lhw=SIZE.repeat(2, 1),
            ignore_xyxy=torch.zeros(0, 4),
        )

    def frame(self, identifier: str) -> Frame:
        """Grey. FormatError where it is damaged."""
        if identifier in self._damaged:
            raise FormatError(f"{identifier}.png", "an image", "none")
        camera = Camera(torch.tensor([[90.0, 0, 50], [0, 90, 30], [0, 0, 1]]), 60, 100)
        return Frame(identifier, torch.zeros(3, 60, 100), camera, labels=self.labels(identifier))


@pytest.fixture
def taker(
    street: Callable[..., SceneIR], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[ClipDerenderer, dict[str, list[str]]]]:
    """What takes the clip apart, and the meshes that each frame's cars got."""

    def shapes(frame: Frame, _: DerenderSettings) -> dict[int, Placement]:
        here = torch.zeros(3), torch.tensor(0.0)
        return {row: place_mesh(MESHES[frame.identifier], *here, SIZE) for row in range(len(TRACKS))}

    def build(*damaged: str, keep_going: bool) -> tuple[ClipDerenderer, dict[str, list[str]]]:
        meshes: dict[str, list[str]] = {}

        def derender(frame: Frame, settings: DerenderSettings) -> SceneIR:
            names = [known.mesh.name for known in settings.known_placements or () if known is not None]
            meshes[frame.identifier] = [name.split("-")[0] for name in names]
            return street([(-2.0, 15.0), (3.0, 20.0)])

        clip = Clip("clip", Drive(*damaged), NAMES, lambda _: TRACKS)
        monkeypatch.setattr(taking, "find_clips", lambda _: {"clip": clip})
        monkeypatch.setattr(taking, "place_vehicles", shapes)
        monkeypatch.setattr(taking, "derender", derender)
        return ClipDerenderer(ClipSource("folder", None, None, 0, False, keep_going), tmp_path), meshes

    return build


@pytest.mark.parametrize("order", [NAMES, NAMES[::-1], ("b", "a", "c")])
def test_the_next_best_view_stands_in_for_a_damaged_one(
    order: tuple[str, ...], taker: Callable[..., tuple[ClipDerenderer, dict[str, list[str]]]]
) -> None:
    whole, meshes = taker(keep_going=True)
    for name in order:
        whole.frames.scene(name)
    assert meshes == {name: ["van", "van"] for name in order}
    damaged, meshes = taker("b", keep_going=True)
    for name in order:
        if name == "b":
            with pytest.raises(FormatError, match=r"b\.png"):
                damaged.frames.scene(name)
        else:
            damaged.frames.scene(name)
    assert meshes == {name: ["suv", "sedan"] for name in order if name != "b"}


def test_without_keep_going_no_frame_is_taken_apart_with_another_shape(
    taker: Callable[..., tuple[ClipDerenderer, dict[str, list[str]]]],
) -> None:
    """The picture is repaired, and the command goes on: all of its frames have the best view's shapes."""
    damaged, meshes = taker("b", keep_going=False)
    for name in NAMES:
        with pytest.raises(FormatError, match=r"b\.png"):
            damaged.frames.scene(name)
    assert not meshes


@pytest.mark.parametrize("people", [False, True])
def test_people_become_objects_where_they_are_chosen(
    people: bool,
    taker: Callable[..., tuple[ClipDerenderer, dict[str, list[str]]]],
    street: Callable[..., SceneIR],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """The first label is cut out, and the second one's person stays in the background."""

    def derender(_: Frame, settings: DerenderSettings) -> SceneIR:
        assert settings.people == people
        return replace(
            street([(-2.0, 15.0)]), provenance={"objects[0].label": "0", "labels[1].background": "sitting"}
        )

    taker(keep_going=False)
    monkeypatch.setattr(taking, "derender", derender)
    source = ClipSource("folder", None, None, 0, False, False, people)
    scene = ClipDerenderer(source, tmp_path).frames.scene("a")
    assert object_tracks(scene) == (4,)
    assert background_people(scene) == {7}


def test_a_damaged_first_image_leaves_a_camera(
    taker: Callable[..., tuple[ClipDerenderer, dict[str, list[str]]]],
) -> None:
    camera = taker("a", keep_going=True)[0].frames.camera()
    assert camera is not None
    assert (camera.width, camera.height) == (100, 60)
    assert taker(*NAMES, keep_going=True)[0].frames.camera() is None
    with pytest.raises(FormatError, match=r"a\.png"):
        taker("a", keep_going=False)[0].frames.camera()
