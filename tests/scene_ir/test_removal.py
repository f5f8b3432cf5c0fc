"""Taking vehicles out: the background shows, nothing else changes, and what was hidden is there."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch

from scene_ir.errors import RangeError
from scene_ir.io import load_scene, save_scene
from scene_ir.removal import remove_objects
from scene_ir.render.compositor import render
from scene_ir.types import Objects, Render, SceneIR, Source, convert_scene

NEAR, FAR = 1, 2
"""Rows of two cars of which the first hides part of the second."""


@pytest.fixture(scope="module")
def scene(photographed: SceneIR) -> SceneIR:
    taken = convert_scene(photographed, torch.float32)
    return replace(taken, provenance={"frame": "1", "objects[0].label": "4", "objects[2].label": "7"})


def picture(scene: SceneIR) -> torch.Tensor:
    return render([scene])[0].image


def region(scene: SceneIR, render_picture: Render, row: int) -> torch.Tensor:
    """(H, W) bool: where an object or its shadow has any effect."""
    mask = torch.zeros(scene.camera.height, scene.camera.width, dtype=torch.bool)
    shadow = scene.objects.source[row].shadow
    parts = [(render_picture.opacity[row], render_picture.opacity[row].values > 0)]
    if shadow is not None:
        parts.append((shadow, (shadow.values < 1).any(dim=0, keepdim=True)))
    for crop, used in parts:
        h, w = used.shape[1:]
        mask[crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w] |= used[0]
    return mask


def remaining_rows(objects: Objects, rows: list[int]) -> Objects:
    """The objects of some rows, their sources untouched: removal that forgets what hid what."""
    tensors = {f.name: getattr(objects, f.name)[rows] for f in fields(Objects) if f.name != "source"}
    return replace(objects, source=tuple(objects.source[row] for row in rows), **tensors)


@pytest.mark.parametrize("row", [0, 1, 2])
def test_the_background_shows_and_the_others_keep_every_bit(scene: SceneIR, row: int) -> None:
    render_picture = render([scene])[0]
    left = remove_objects(scene, [row])
    after = picture(left)
    mine = region(scene, render_picture, row)
    assert mine.sum() > 100
    assert torch.equal(after[:, ~mine], render_picture.image[:, ~mine])
    alone = mine.clone()
    for other in {0, 1, 2} - {row}:
        alone &= ~region(scene, render_picture, other)
    assert alone.sum() > 30
    assert torch.equal(after[:, alone], scene.background[:, alone])
    assert not torch.equal(after[:, alone], render_picture.image[:, alone])


def test_without_any_the_background_is_left(scene: SceneIR) -> None:
    empty = remove_objects(scene, [0, 1, 2])
    assert len(empty.objects) == 0
    assert torch.equal(picture(empty), scene.background)
    assert not [key for key in empty.provenance if key.startswith("objects")]


def test_what_it_hid_is_completed(scene: SceneIR) -> None:
    before = render([scene])[0].opacity[FAR]
    after = render([remove_objects(scene, [NEAR])])[0].opacity[FAR - 1]
    assert (after.x0, after.y0, after.values.shape) == (before.x0, before.y0, before.values.shape)
    torch.testing.assert_close(after.values, before.values, atol=0.02, rtol=0)
    forgetful = replace(scene, objects=remaining_rows(scene.objects, [0, FAR]))
    assert float(render([forgetful])[0].opacity[1].values.sum()) < 0.9 * float(before.values.sum())


def whole(scene: SceneIR, source: Source) -> torch.Tensor:
    """A foreground in its frame, (4, H, W)."""
    frame = torch.zeros(4, scene.camera.height, scene.camera.width)
    crop = source.foreground
    h, w = crop.values.shape[1:]
    frame[:, crop.y0 : crop.y0 + h, crop.x0 : crop.x0 + w] = crop.values
    return frame


@pytest.mark.parametrize("row", [0, 1, 2])
def test_only_what_it_hid_changes(scene: SceneIR, row: int) -> None:
    left = remove_objects(scene, [row]).objects
    rows = [i for i in range(3) if i != row]
    free = whole(scene, scene.objects.source[row])[3] == 0
    for place, other in enumerate(rows):
        before, after = whole(scene, scene.objects.source[other]), whole(scene, left.source[place])
        assert torch.equal(after[:, free], before[:, free])
    if row == FAR:
        assert left.source == scene.objects.source[:FAR]
    remaining = remaining_rows(scene.objects, rows)
    for name in (f.name for f in fields(Objects) if f.name != "source"):
        assert torch.equal(getattr(left, name), getattr(remaining, name))


def test_one_after_the_other_or_together(scene: SceneIR) -> None:
    """The same but for what both hid, at the rim of one and inside the other."""
    together = picture(remove_objects(scene, [0, NEAR]))
    one_by_one = picture(remove_objects(remove_objects(scene, [NEAR]), [0]))
    off = (together - one_by_one).abs().amax(dim=0)
    assert float(off.max()) < 0.1
    assert int((off > 2e-3).sum()) <= 10


def test_moves_do_not_matter(scene: SceneIR) -> None:
    """What was hidden is a fact of the photograph, not of where the cars stand now."""
    shift = torch.tensor([[0.3, 0.0, 0.2]])
    moved = scene.with_objects(translation=scene.objects.translation + shift, yaw=scene.objects.yaw + 0.1)
    moved = moved.with_objects(texture_code=torch.full_like(moved.objects.texture_code, 0.3))
    left, right = remove_objects(moved, [NEAR]), remove_objects(scene, [NEAR])
    for one, two in zip(left.objects.source, right.objects.source, strict=True):
        assert torch.equal(one.foreground.values, two.foreground.values)
    assert torch.equal(left.objects.translation, moved.objects.translation[[0, FAR]])


def test_rows_in_the_provenance_move_up(scene: SceneIR) -> None:
    assert remove_objects(scene, [0]).provenance == {"frame": "1", "objects[1].label": "7"}
    assert remove_objects(scene, [NEAR]).provenance == {
        "frame": "1",
        "objects[0].label": "4",
        "objects[1].label": "7",
    }


def test_it_survives_a_file(scene: SceneIR, tmp_path: Path) -> None:
    left = remove_objects(scene, [NEAR])
    save_scene(left, tmp_path / "scene")
    assert torch.equal(picture(load_scene(tmp_path / "scene")), picture(left))


def test_nothing_to_remove_and_nothing_photographed(
    scene: SceneIR, street: Callable[[torch.dtype], SceneIR]
) -> None:
    assert remove_objects(scene, []) is scene
    bare = remove_objects(street(torch.float32), [0, 2])
    assert bare.objects.source == ()
    assert len(bare.objects) == 1


@pytest.mark.parametrize("row", [-1, 3])
def test_an_unknown_row_is_named(scene: SceneIR, row: int) -> None:
    with pytest.raises(RangeError, match=f"a row from 0 to 2, found {row}"):
        remove_objects(scene, [row])
