"""People and cyclists as upright surfaces: cut out of a painted street, put back, moved."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from drivesem.attacks.labels import hidden_shares
from scene_ir.derender import people, upright
from scene_ir.derender.derender import DerenderSettings, derender
from scene_ir.derender.silhouette import grow_mask, render_silhouettes
from scene_ir.errors import RangeError
from scene_ir.exchange import CHANGE_KEY, relocate_person
from scene_ir.geometry import project
from scene_ir.io import load_scene, save_scene
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.render.surfaces import TemplateSurface
from scene_ir.types import Category, Frame, Labels, Part, SceneIR, convert_scene

FOCAL, CENTRE, HORIZON = 380.0, 239.5, 88.0
PLACE = (-2.5, 1.65, 9.0)
CLOTHES = np.array([0.75, 0.2, 0.15], np.float32)


def paint_person(image: np.ndarray, place: tuple[float, float, float]) -> np.ndarray:
    """Paint a person who stands at a place, 1.75 m high, into an image (H, W, 3); the opacity (H, W)."""
    x, ground, z = place
    scale = 16.0
    share = np.zeros((int(image.shape[0] * scale / 4), int(image.shape[1] * scale / 4)), np.uint8)

    def at(right: float, up: float) -> tuple[int, int]:
        u, v = CENTRE + FOCAL * (x + right) / z, HORIZON + FOCAL * (ground - up) / z
        return round((u + 0.5) * scale / 4), round((v + 0.5) * scale / 4)

    def size(metres: float) -> int:
        return max(round(FOCAL * metres / z * scale / 4), 1)

    cv2.circle(share, at(0, 1.62), size(0.13), 255, -1)
    cv2.rectangle(share, at(-0.22, 1.48), at(0.22, 0.85), 255, -1)
    for side in (-1, 1):
        cv2.line(share, at(0.1 * side, 0.85), at(0.16 * side, 0.03), 255, size(0.14))
    alpha = cv2.resize(share, image.shape[1::-1], interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    rows = np.arange(image.shape[0])[:, None, None]
    head = HORIZON + FOCAL * (ground - 1.48) / z
    colour = np.where(rows < head, np.array([0.8, 0.6, 0.5], np.float32), CLOTHES)
    image += alpha[..., None] * (colour - image)
    return alpha


def label_person(labels: Labels, mask: np.ndarray, **changes: object) -> Labels:
    """The labels and that of a person with this mask."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    box = torch.tensor([[columns[0], rows[0], columns[-1], rows[-1]]], dtype=torch.float32)
    own = {
        "boxes_xyxy": box,
        "truncation": torch.zeros(1),
        "occlusion": torch.zeros(1, dtype=torch.int64),
        "translation": torch.tensor([PLACE]),
        "yaw": torch.tensor([0.4]),
        "size_lhw": torch.tensor([[0.8, 1.75, 0.6]]),
    }
    own |= {name: torch.as_tensor(value) for name, value in changes.items() if name != "kind"}
    joined = {name: torch.cat([getattr(labels, name), value]) for name, value in own.items()}
    return replace(labels, kind=(*labels.kind, str(changes.get("kind", "Pedestrian"))), **joined)


@pytest.fixture(scope="module")
def crossing(street) -> Frame:
    """The street with a person to the left of the car, and exact masks."""
    image = street.frame.photograph.permute(1, 2, 0).numpy().copy()
    alpha = paint_person(image, PLACE)
    photograph = torch.from_numpy(np.rint(image * 255).astype(np.float32) / 255).permute(2, 0, 1).contiguous()
    masks = torch.from_numpy(np.stack([street.mask.astype(np.float32), alpha]))
    labels = label_person(street.frame.labels, alpha > 0.5)
    return replace(street.frame, photograph=photograph, labels=labels, masks=masks)


@pytest.fixture(scope="module")
def scene(crossing) -> SceneIR:
    return derender(crossing, DerenderSettings(fit=False, people=True))


def shift(scene: SceneIR, right_m: float) -> SceneIR:
    """The scene with its person further to the right."""
    translation = scene.objects.translation.clone()
    translation[1, 0] += right_m
    return scene.with_objects(translation=translation)


def test_people_are_background_unless_they_are_chosen(crossing, scene):
    without = derender(crossing, DerenderSettings(fit=False))
    assert without.objects.category.tolist() == [Category.CAR]
    assert without.other_labels is not None
    assert without.other_labels.kind == ("Pedestrian",)
    assert scene.objects.category.tolist() == [Category.CAR, Category.PEDESTRIAN]
    assert scene.objects.upright.tolist() == [False, True]
    assert scene.other_labels is not None
    assert scene.other_labels.kind == ()
    assert scene.occluders == ()


def test_the_render_is_the_photograph_to_the_level(crossing, scene):
    image = Compositor(scene).render(scene).image
    assert torch.equal((image * 255).round(), (crossing.photograph * 255).round())


def test_a_moved_person_is_drawn_where_the_street_shows_it(crossing, street, scene):
    before = street.frame.photograph.permute(1, 2, 0).numpy()
    image = before.copy()
    alpha = paint_person(image, (PLACE[0] + 0.7, *PLACE[1:]))
    moved = Compositor(scene).render(shift(scene, 0.7)).image.permute(1, 2, 0).numpy()
    window = np.s_[75:165, 90:200]
    assert np.abs(moved - image)[window].mean() < 0.02
    person = alpha > 0.9
    assert np.abs(moved - image)[person].mean() < 0.04
    left_behind = (crossing.masks[1].numpy() > 0.5) & (alpha == 0)
    assert np.abs(moved - before)[left_behind].mean() < 0.1


def test_clothes_change_colour_and_the_head_does_not(crossing, scene):
    code = scene.objects.texture_code.clone()
    code[1, 0] = 0.6
    change = (Compositor(scene).render(scene.with_objects(texture_code=code)).image - crossing.photograph).abs()
    person = crossing.masks[1].numpy() > 0.95
    cell_m = 1.75 / upright.UNDER_MATTE.cells  # over which clothes end
    head = np.arange(person.shape[0])[:, None] < 88 + FOCAL * (1.65 - 1.52 - cell_m) / 9
    assert float(change[:, torch.from_numpy(person & ~head)].mean()) > 0.03
    assert float(change[:, torch.from_numpy(person & head)].mean()) < 0.003


def recolour(scene: SceneIR, **codes: list[float]) -> SceneIR:
    """The scene with codes of its person's clothes: upper, lower."""
    code = scene.objects.texture_code.clone()
    for name, values in codes.items():
        code[1, {"upper": slice(0, 3), "lower": slice(5, 8)}[name]] = torch.tensor(values).to(code)
    return scene.with_objects(texture_code=code)


@pytest.mark.parametrize("backend", ["warp", "reference"])
def test_clothes_above_and_below_the_waist_change_apart(crossing, scene, backend):
    compositor = Compositor(scene, RenderSettings(backend))
    waist = [88 + FOCAL * (1.65 - share * 1.75) / 9 for share in (0.57, 0.49)]
    rows = np.arange(crossing.masks.shape[1])
    still = compositor.render(scene).image
    for part, elsewhere in (("upper", rows > waist[1]), ("lower", rows < waist[0])):
        image = compositor.render(recolour(scene, **{part: [0.5, 0.5, -0.5]})).image
        change = (image - still).abs().amax(dim=0)
        assert float(change.max()) > 0.1
        assert float(change[torch.from_numpy(elsewhere)].max()) == 0
    both = compositor.render(recolour(scene, upper=[0.3, 0.2, -0.4], lower=[0.3, 0.2, -0.4])).image
    old = scene.with_objects(texture_code=scene.objects.texture_code[:, :5])
    alike = Compositor(old, RenderSettings(backend)).render(
        old.with_objects(texture_code=torch.tensor([[0.0] * 5, [0.3, 0.2, -0.4, 0.0, 0.0]]))
    )
    assert torch.equal(both, alike.image), "five codes change all clothes alike"


@pytest.mark.parametrize("category", [Category.CAR, Category.CYCLIST])
def test_only_pedestrians_have_clothes_of_two_parts(scene, category):
    other = scene.with_objects(category=torch.tensor([int(Category.CAR), int(category)]))
    compositor = Compositor(other)
    assert torch.equal(
        compositor.render(recolour(other, upper=[0.4, 0, 0], lower=[0, 0.5, 0])).image,
        compositor.render(recolour(other, upper=[0.4, 0, 0])).image,
    )


def test_code_zero_of_clothes_changes_no_bit(scene):
    compositor = Compositor(scene)
    code = torch.zeros(2, 8, requires_grad=True)
    assert torch.equal(
        compositor.render(scene.with_objects(texture_code=code)).image.detach(), compositor.render(scene).image
    )


@pytest.mark.parametrize("start", [0.0, pytest.param(0.3, marks=pytest.mark.slow)])
def test_the_gradient_of_clothes_is_that_of_differences_and_the_kernels(scene, start):
    weights = torch.linspace(0, 1, scene.camera.height)[:, None]
    chosen, slopes = [0, 1, 2, 5, 6, 7], {}
    for backend, dtype in (("reference", torch.float64), ("warp", torch.float32)):
        exact = convert_scene(shift(scene, 0.4), dtype)
        compositor = Compositor(exact, RenderSettings(backend))

        def total(code: torch.Tensor, compositor=compositor, exact=exact) -> torch.Tensor:
            return (compositor.render(exact.with_objects(texture_code=code)).image * weights.to(code)).sum()

        code = torch.zeros(2, 8, dtype=dtype)
        code[1, chosen] = start
        leaf = code.clone().requires_grad_()
        slopes[backend] = torch.autograd.grad(total(leaf), leaf)[0][1, chosen].double()
        if dtype == torch.float64:
            steps = torch.eye(8, dtype=dtype)[chosen] * 1e-5
            rows = torch.tensor([[0.0], [1.0]], dtype=dtype)
            with torch.no_grad():
                ends = [total(code + rows * step) - total(code - rows * step) for step in steps]
            slopes["differences"] = torch.stack(ends) / 2e-5
    assert bool((slopes["differences"].abs() > 0.1).all())
    torch.testing.assert_close(slopes["reference"], slopes["differences"], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(slopes["warp"], slopes["reference"], rtol=1e-3, atol=1e-3)


def test_the_gradient_of_a_persons_place_is_that_of_differences(scene):
    exact = convert_scene(shift(scene, 0.13), torch.float64)
    compositor = Compositor(exact, RenderSettings("reference"))
    weights = torch.linspace(0, 1, exact.camera.width, dtype=torch.float64)

    def total(right_m: torch.Tensor) -> torch.Tensor:
        offset = torch.stack([right_m, right_m * 0, right_m * 0])
        rows = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
        moved = exact.with_objects(translation=exact.objects.translation + rows * offset)
        return (compositor.render(moved).image * weights).sum()

    at = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(total(at), at)
    step = torch.tensor(1e-4, dtype=torch.float64)
    difference = float((total(step) - total(-step)) / 2e-4)
    assert float(slope) == pytest.approx(difference, rel=0.02)


def test_the_kernels_draw_people_as_the_reference_does(scene):
    moved = recolour(shift(scene, 0.4), upper=[0.4, -0.3, 0.2], lower=[-0.4, 0.2, 0.5])
    images = [Compositor(scene, RenderSettings(name)).render(moved).image for name in ("warp", "reference")]
    assert float((images[0] - images[1]).abs().max()) < 1e-3


def test_a_saved_scene_holds_its_people(scene, tmp_path):
    scene = recolour(scene, upper=[0.25, 0.0, 0.0], lower=[0.0, 0.5, 0.0])
    save_scene(scene, tmp_path / "scene")
    loaded = load_scene(tmp_path / "scene")
    assert torch.equal(loaded.objects.category, scene.objects.category)
    assert torch.equal(loaded.objects.texture_code, scene.objects.texture_code)
    moved = [Compositor(one).render(shift(one, 0.5)).image for one in (scene, loaded)]
    assert float((moved[0] - moved[1]).abs().max()) < 0.01


def test_a_scene_saved_with_five_codes_keeps_them(scene, tmp_path):
    old = scene.with_objects(texture_code=torch.tensor([[0.0] * 5, [0.25, 0.0, 0.5, 0.0, 0.0]]))
    save_scene(old, tmp_path / "scene")
    assert torch.equal(load_scene(tmp_path / "scene").objects.texture_code, old.objects.texture_code)


def test_a_person_stands_behind_a_vehicle_as_if_photographed_there(scene):
    ahead = scene.objects.translation[0] + torch.tensor([-1.0, 0.0, 3.5])
    there = relocate_person(scene, 1, ahead, 0)
    assert there.provenance[CHANGE_KEY] == "objects[1] stands behind objects[0]"
    assert torch.equal(there.origin.objects.translation, scene.objects.translation)
    compositor = Compositor(there)
    drawn = compositor.render(there)
    shares = hidden_shares(drawn)
    assert 0.0 < shares[1] < 1.0
    assert shares[0] == 0.0
    assert float((compositor.render(there.origin).image - scene.photograph).abs().max()) < 1e-3
    feet = project(ahead[None], scene.camera.matrix)[0]
    crop = there.objects.source[1].foreground
    lowest = crop.y0 + int((crop.values[3] > 0.5).any(dim=1).nonzero().max())
    assert lowest == pytest.approx(float(feet[1]), abs=3)
    with pytest.raises(RangeError, match="a row of a person or cyclist"):
        relocate_person(scene, 0, ahead, 0)


@pytest.mark.parametrize(
    ("reason", "changes"),
    [
        ("partly hidden", {"occlusion": [1]}),
        ("cut by the border", {"truncation": [0.3]}),
        ("cut by the border", {"boxes_xyxy": [[0.0, 84.0, 30.0, 158.0]]}),
        ("lower than 25 px", {"boxes_xyxy": [[120.0, 100.0, 130.0, 120.0]]}),
        ("sitting", {"kind": "Person_sitting"}),
        ("no 3D box", {"size_lhw": [[-1.0, -1.0, -1.0]]}),
        ("no clean outline", {"boxes_xyxy": [[100.0, 84.0, 200.0, 158.0]]}),
    ],
)
def test_who_cannot_be_cut_out_whole_stays_background_with_a_reason(crossing, street, reason, changes):
    labels = label_person(street.frame.labels, crossing.masks[1].numpy() > 0.5, **changes)
    scene = derender(replace(crossing, labels=labels), DerenderSettings(fit=False, people=True))
    assert scene.objects.category.tolist() == [Category.CAR]
    assert scene.provenance["labels[1].background"] == reason


def test_who_stands_behind_the_own_bonnet_stays_background(crossing):
    rows = np.flatnonzero((crossing.masks[1].numpy() > 0.5).any(1))
    classes = torch.zeros(crossing.masks.shape[1:], dtype=torch.int64)
    classes[rows[-8] :] = 1
    frame = replace(crossing, classes=classes, class_names=("road", "ego vehicle"))
    scene = derender(frame, DerenderSettings(fit=False, people=True))
    assert Category.PEDESTRIAN not in scene.objects.category.tolist()
    assert scene.provenance["labels[1].background"] == "behind the ego vehicle"


def test_a_person_leaves_whole_though_the_mask_of_somebody_behind_covers_it(crossing, scene):
    own = crossing.masks[1].numpy()
    rows = np.flatnonzero((own > 0.5).any(1))
    behind = own.copy()
    behind[rows[0] + round(0.8 * len(rows)) :] = 0
    far = torch.tensor([[PLACE[0], PLACE[1], PLACE[2] + 0.7]])  # nearer than the car
    labels = label_person(crossing.labels, behind > 0.5, occlusion=[1], translation=far)
    frame = replace(crossing, labels=labels, masks=torch.cat([crossing.masks, torch.from_numpy(behind)[None]]))
    found = derender(frame, DerenderSettings(fit=False, people=True))
    assert found.objects.category.tolist() == [Category.CAR, Category.PEDESTRIAN]
    solid = torch.from_numpy(own > 0.9)
    changed = (found.background - found.photograph).abs().amax(0)[solid]
    usual = (scene.background - scene.photograph).abs().amax(0)[solid]
    assert float((changed > 0.02).double().mean()) > 0.9 * float((usual > 0.02).double().mean()) > 0.5


def test_what_is_labelled_and_stays_goes_on_behind_a_person(crossing, scene):
    own = crossing.masks[1].numpy() > 0.5
    rows, columns = np.flatnonzero(own.any(1)), np.flatnonzero(own.any(0))
    tram = np.zeros(own.shape, np.float32)
    tram[: rows[-1] - len(rows) // 5, max(columns[0] - len(rows), 0) : columns[-1] + len(rows)] = 1
    far = torch.tensor([[PLACE[0], PLACE[1], PLACE[2] + 9]])
    labels = label_person(crossing.labels, tram > 0, kind="Tram", translation=far)
    frame = replace(
        crossing, labels=labels, masks=torch.cat([crossing.masks, torch.from_numpy(tram * ~own)[None]])
    )
    found = derender(frame, DerenderSettings(fit=False, people=True))
    assert found.objects.category.tolist() == [Category.CAR, Category.PEDESTRIAN]
    assert float((found.background - scene.background).abs()[:, own].mean()) < 0.02


def test_people_who_overlap_stay_background(crossing):
    twice = label_person(crossing.labels, crossing.masks[1].numpy() > 0.5)
    masks = torch.cat([crossing.masks, crossing.masks[1:]])
    scene = derender(replace(crossing, labels=twice, masks=masks), DerenderSettings(fit=False, people=True))
    assert scene.objects.category.tolist() == [Category.CAR]
    assert {scene.provenance[f"labels[{row}].background"] for row in (1, 2)} == {"overlaps others"}


def split_person(crossing, share: float) -> Frame:
    """The crossing with its person labelled as a cyclist's upper part, and a bicycle's lower one."""
    mask = crossing.masks[1].numpy()
    rows = np.flatnonzero((mask > 0.5).any(1))
    edge = rows[0] + round(share * len(rows))
    parts = [mask.copy(), mask.copy()]
    parts[0][edge + 5 :], parts[1][: edge - 5] = 0, 0
    labels = label_person(crossing.labels.select([0]), parts[0] > 0.5, kind="Cyclist")
    labels = label_person(labels, parts[1] > 0.5, kind="Bicycle")
    masks = torch.cat([crossing.masks[:1], torch.from_numpy(np.stack(parts))])
    return replace(crossing, labels=labels, masks=masks, provenance={"labels[1].name": "rider"})


def test_rider_and_two_wheeler_with_labels_of_their_own_are_one_object(crossing):
    frame = split_person(crossing, 0.8)
    boxes = frame.labels.boxes_xyxy.clone()
    boxes[1, 3] = boxes[2, [1, 3]].mean()  # the feet are beside the wheels
    labels = replace(frame.labels, boxes_xyxy=boxes)
    scene = derender(replace(frame, labels=labels), DerenderSettings(fit=False, people=True))
    assert scene.objects.category.tolist() == [Category.CAR, Category.CYCLIST]
    assert torch.equal(scene.objects.box2d[1], labels.boxes_xyxy[1].float()), "the label stays the data set's"
    assert scene.other_labels.kind == (), "the two-wheeler moves with its rider"
    whole = frame.masks[1:].amax(0).numpy() > 0.5
    crop = scene.objects.source[1].foreground
    height = np.flatnonzero((crop.values[3].numpy() > 0.5).any(1))
    assert len(height) == pytest.approx(np.flatnonzero(whole.any(1)).size, abs=4)


def test_a_rider_without_a_two_wheeler_stays_background(crossing):
    frame = split_person(crossing, 0.8)
    frame = replace(frame, labels=frame.labels.select([0, 1]), masks=frame.masks[:2])
    scene = derender(frame, DerenderSettings(fit=False, people=True))
    assert scene.objects.category.tolist() == [Category.CAR]
    assert scene.provenance["labels[1].background"] == "no two-wheeler"


def test_each_rider_has_the_two_wheeler_that_overlaps_most(crossing):
    boxes = torch.tensor(
        [[0.0, 0, 20, 40], [8, 0, 28, 40], [2, 25, 22, 60], [15, 15, 35, 60], [300, 0, 320, 40], [0, 100, 20, 140]]
    )
    kinds = ("Cyclist", "Cyclist", "Bicycle", "Motorcycle", "Bicycle", "Cyclist")
    labels = replace(crossing.labels.select([0] * 6), kind=kinds, boxes_xyxy=boxes)
    whole, ridden = people.join_riders(labels)
    assert ridden == {0: 2, 1: 3}
    assert whole[:2].tolist() == [[0, 0, 22, 60], [8, 0, 35, 60]]
    assert torch.equal(whole[2:], boxes[2:])


def test_the_network_finds_the_person_in_its_box(crossing):
    frame = replace(crossing, masks=None)
    picture = np.rint(crossing.photograph.permute(1, 2, 0).numpy() * 255).astype(np.uint8)
    ground = torch.tensor([0.0, -1.0, 0.0, 1.65])
    cuts, _ = people.cut_out_people(picture, frame, [0, 1], ground, "warp")
    assert [cut.row for cut in cuts] == [1]
    true = crossing.masks[1].numpy() > 0.5
    assert (cuts[0].mask & true).sum() / (cuts[0].mask | true).sum() > 0.8


def test_a_surface_is_closed_covers_its_mask_and_faces_the_camera(crossing):
    mask = crossing.masks[1].numpy() > 0.5
    pose = torch.tensor(PLACE), torch.tensor(0.4), torch.tensor([0.8, 1.75, 0.6])
    placement = upright.make_placement(mask, "Pedestrian", pose, crossing.camera)
    surface = TemplateSurface.from_mesh(placement.mesh, torch.float32)
    assert surface.closed
    assert bool((surface.neighbours >= 0).all())
    assert set(placement.mesh.part.tolist()) == {Part.PAINT, Part.OTHER}
    (outline,) = render_silhouettes([placement], crossing.camera)
    assert not (mask & ~outline).any()
    assert outline.sum() < 1.6 * mask.sum()
    depth = placement.vertices()[:, 2]
    assert 8.8 < float(depth.min()) < float(depth.max()) < 9.1


def test_heights_of_clothes_are_those_of_the_body_without_its_soft_border(crossing):
    body = crossing.masks[1].numpy() > 0.5
    pose = torch.tensor(PLACE), torch.tensor(0.4), torch.tensor([0.8, 1.75, 0.6])
    placement = upright.make_placement(grow_mask(body, 4), "Pedestrian", pose, crossing.camera, body=body)
    rows = np.flatnonzero(body.any(1))
    clothed = placement.mesh.faces[placement.mesh.part == Part.PAINT]
    pixels = project(placement.vertices().float(), crossing.camera.matrix)[clothed].mean(1)[:, 1]
    height = rows[-1] + 1 - rows[0]
    assert float(pixels.min()) == pytest.approx(rows[-1] + 0.5 - 0.86 * height, abs=2.5)
    assert float(pixels.max()) == pytest.approx(rows[-1] + 0.5 - 0.05 * height, abs=2.5)


def test_an_outline_of_its_own_follows_the_mask(crossing):
    mask = crossing.masks[1].numpy() > 0.5
    pose = torch.tensor(PLACE), torch.tensor(0.4), torch.tensor([0.8, 1.75, 0.6])
    placement = upright.make_placement(mask, "Pedestrian", pose, crossing.camera, upright.ALONG_MASK)
    (outline,) = render_silhouettes([placement], crossing.camera)
    assert (outline & mask).sum() / (outline | mask).sum() > 0.9


@pytest.mark.parametrize("box", [(100.0, 84.0, 130.0, 158.0), (400.0, 60.0, 440.0, 190.0)])
def test_the_guide_fills_the_box_of_the_label(crossing, box):
    foot = torch.tensor([(sum(box[::2]) / 2 - CENTRE) * 9 / FOCAL, 1.65, 9.0])
    placement = upright.place_box(torch.tensor(box), foot, crossing.camera)
    pixels = project(placement.vertices(), crossing.camera.matrix)
    found = [*pixels.min(0).values.tolist(), *pixels.max(0).values.tolist()]
    assert found == pytest.approx(box, abs=4.0)
