"""Photographs without labels: camera, detections as labels, and how well the shipped network places vehicles."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from detectors.types import CLASSES, Detections
from drivesem.cli import main
from drivesem.data.kitti import KittiDataset
from drivesem.data.registry import open_dataset
from drivesem.scenes.label_free import (
    FIT_TO_DETECTIONS,
    detect,
    detection_fit_settings,
    estimate_label_poses,
    has_poses,
    label_from_detections,
)
from drivesem.synth.frames import SynthFrame, generate_frame
from scene_ir.derender import pose
from scene_ir.derender.derender import DerenderSettings
from scene_ir.errors import RangeError
from scene_ir.geometry import clip_boxes, project_boxes
from scene_ir.io import load_scene
from scene_ir.types import Camera, Frame, Labels

KITTI = Path(__file__).parents[3].parent / "shared" / "data" / "kitti"
SEED, FRAMES = 2027, range(12)
"""Held-out streets that the network was neither trained nor judged on."""
CAR, TRUCK, PEDESTRIAN = (CLASSES.index(name) for name in ("Car", "Truck", "Pedestrian"))


def frame_of(width: int = 1242, height: int = 375) -> Frame:
    k = torch.tensor([[720.0, 0.0, (width - 1) / 2], [0.0, 720.0, 172.0], [0.0, 0.0, 1.0]])
    picture = torch.rand(3, height, width, generator=torch.Generator().manual_seed(0))
    return Frame("one", picture, Camera(k, height, width))


def seen(boxes: list[list[float]], labels: list[int]) -> Detections:
    return Detections(torch.tensor(boxes).reshape(-1, 4), torch.tensor(labels), torch.full((len(labels),), 0.9))


def test_detections_become_labels() -> None:
    frame = frame_of()
    boxes = [[550.0, 170, 650, 240], [0, 170, 120, 320], [560, 150, 590, 260], [700, 120, 800, 230]]
    found = label_from_detections(frame, seen(boxes, [CAR, CAR, PEDESTRIAN, TRUCK]))
    labels = found.labels
    assert labels is not None
    assert labels.kind == ("Car", "Car", "Pedestrian", "Truck")
    for values in (labels.translation, labels.yaw, labels.size_lhw, labels.truncation):
        assert bool(torch.isfinite(values).all())
    full = project_boxes(labels.size_lhw, labels.yaw, labels.translation, frame.camera.matrix)
    vehicles = [0, 1, 3]
    torch.testing.assert_close(labels.boxes_xyxy[vehicles], clip_boxes(full, 375, 1242)[vehicles])
    assert labels.boxes_xyxy[2].tolist() == boxes[2]
    assert labels.truncation[[0, 2, 3]].tolist() == [0, 0, 0]
    assert found.provenance["labels"] == "estimated"
    assert set(found.provenance) >= {"labels[0].score", "labels[0].facing", "labels[3].depth_sigma"}
    assert found.photograph is frame.photograph
    # the pedestrian stands on the ground that the cars stand on, or is as far as it is small
    assert float(labels.translation[2, 2]) == pytest.approx(720 * 1.75 / 110, rel=0.6)


def test_boxes_on_the_ego_vehicle_become_no_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    bonnet = np.zeros((375, 1242), bool)
    bonnet[300:] = True
    monkeypatch.setattr("scene_ir.derender.ego.find_ego_vehicle", lambda _: bonnet)
    boxes = [[550.0, 170, 650, 240], [400, 280, 700, 374], [0, 170, 120, 320]]
    found = label_from_detections(frame_of(), seen(boxes, [CAR, CAR, TRUCK]))
    assert found.labels is not None
    assert found.labels.kind == ("Car", "Truck")
    assert found.labels.boxes_xyxy[0].tolist() == pytest.approx(boxes[0], abs=25)


def known(places: torch.Tensor) -> Callable[..., pose.VehiclePoses]:
    """An estimate that puts cars, all heading away, at these places on a level road."""
    count = len(places)
    one, ground = torch.ones(count), torch.tensor([0.0, -1, 0, 1.65])
    size = torch.tensor([4.0, 1.5, 1.7]).expand(count, 3)
    poses = pose.VehiclePoses(places, one * math.pi / 2, size, ("sedan",) * count, 0.05 * one, one, ground)
    return lambda *_, **__: poses


def cars(count: int) -> Detections:
    return seen([[100.0 * i, 100, 100 * i + 50, 150] for i in range(count)], [CAR] * count)


def test_what_is_behind_is_hidden_and_what_leaves_the_image_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """One car behind another, one beside, one half out of the image, one behind the camera."""
    places = torch.tensor([[0.0, 1.65, 10], [0.3, 1.65, 20], [9, 1.65, 20], [-8, 1.65, 9.5], [0, 1.65, -5]])
    monkeypatch.setattr("drivesem.scenes.label_free.estimate_poses", known(places))
    labels = label_from_detections(frame_of(), cars(5)).labels
    assert labels is not None
    assert torch.equal(labels.translation, places[:4])
    assert labels.occlusion.tolist() == [0, 3, 0, 0]
    assert labels.truncation[:3].tolist() == [0, 0, 0]
    assert 0.2 < float(labels.truncation[3]) < 0.8
    assert float(labels.boxes_xyxy[3, 0]) == 0


def test_near_vehicles_are_detected_in_a_smaller_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is high, and what is seen there of the same class at about the same place; all else stays."""
    pictures: list[tuple[int, int]] = []
    large = [[100.0, 100, 400, 250], [500, 100, 700, 199], [800, 100, 1000, 260], [1100, 100, 1150, 240]]
    small = [
        [80.0, 90, 450, 290],
        [490, 90, 720, 210],
        [300, 90, 420, 300],
        [790, 95, 1010, 280],
        [1100, 95, 1160, 250],
    ]

    def predict(_: object, images: torch.Tensor) -> list[Detections]:
        height, width = images.shape[2:]
        pictures.append((height, width))
        boxes = torch.tensor(large if width == 1242 else small).reshape(-1, 4)
        labels = torch.tensor([CAR, CAR, CAR, PEDESTRIAN] if width == 1242 else [CAR, CAR, CAR, TRUCK, PEDESTRIAN])
        labels = labels[: len(boxes)]
        ratio = torch.tensor([width / 1242, height / 375]).repeat(2)
        return [Detections((boxes + 0.5) * ratio - 0.5, labels, torch.full((len(boxes),), 0.9))]

    monkeypatch.setattr("drivesem.scenes.label_free.predict", predict)
    found = detect(frame_of())
    assert pictures == [(375, 1242), (225, 745)]
    torch.testing.assert_close(found.boxes_xyxy, torch.tensor([small[0], *large[1:]]), atol=1e-3, rtol=0)
    small.clear()  # nothing is seen there
    torch.testing.assert_close(detect(frame_of()).boxes_xyxy, torch.tensor(large))
    pictures.clear()
    large[:] = large[1:2]
    monkeypatch.setattr(
        "drivesem.scenes.label_free.predict",
        lambda _, images: pictures.append(images.shape[2:]) or [seen(large, [CAR])],
    )
    assert torch.equal(detect(frame_of()).boxes_xyxy, torch.tensor(large))
    assert len(pictures) == 1


def test_boxes_that_end_near_the_border_are_cut_by_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Within a twentieth of their sides, or 2 px; people's boxes stay as they are."""
    requested: list[torch.Tensor] = []

    def estimate(_: torch.Tensor, boxes_xyxy: torch.Tensor, *words: object, **more: object) -> pose.VehiclePoses:
        requested.append(boxes_xyxy)
        return known(torch.tensor([[4.0 * i, 1.65, 20] for i in range(len(boxes_xyxy))]))()

    monkeypatch.setattr("drivesem.scenes.label_free.estimate_poses", estimate)
    boxes = [
        [902.0, 232, 1232, 368],
        [10, 100, 210, 200],
        [11, 100, 211, 200],
        [1.5, 1.5, 30, 30],
        [3, 9, 60, 180],
    ]
    label_from_detections(
        frame_of(), seen([*boxes, [900, 100, 1240, 374]], [CAR, CAR, CAR, TRUCK, CAR, PEDESTRIAN])
    )
    cut = [[902.0, 232, 1241, 374], [0, 100, 210, 200], [11, 100, 211, 200], [0, 0, 30, 30], [3, 9, 60, 180]]
    assert requested[0].tolist() == cut


def test_vehicles_that_cannot_stand_there_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two cars in one place the surer one stays; one above the ground goes; neighbours stay."""
    places = torch.tensor([[0.0, 1.65, 10], [0.4, 1.65, 11], [3.0, 1.65, 10], [6.0, -1.5, 15], [8.0, 2.2, 25]])
    monkeypatch.setattr("drivesem.scenes.label_free.estimate_poses", known(places))
    found = cars(5)
    found.scores[1] = 0.95
    labels = label_from_detections(frame_of(), found).labels
    assert labels is not None
    assert torch.equal(labels.translation, places[[1, 2, 4]])


def test_no_detections_and_wrong_labels() -> None:
    none = label_from_detections(frame_of(), seen([], []))
    assert none.labels is not None
    assert none.labels.kind == ()
    with pytest.raises(RangeError, match="labels"):
        label_from_detections(frame_of(), seen([[0.0, 0, 50, 50]], [9]))
    with pytest.raises(RangeError, match="boxes_xyxy"):
        label_from_detections(frame_of(), seen([[50.0, 0, 50, 50]], [CAR]))


def test_the_fit_may_go_farther_than_from_labels() -> None:
    settings = detection_fit_settings(DerenderSettings(fit=False, seed=3))
    assert (settings.fit, settings.seed, settings.fitting) == (False, 3, FIT_TO_DETECTIONS)
    usual = DerenderSettings().fitting
    assert FIT_TO_DETECTIONS.max_shift_m > usual.max_shift_m
    assert FIT_TO_DETECTIONS.max_turn_rad > usual.max_turn_rad


@pytest.fixture(scope="module")
def streets() -> list[SynthFrame]:
    return [generate_frame(SEED, index, "heldout") for index in FRAMES]


def plain(frame: SynthFrame) -> Frame:
    return Frame("street", torch.from_numpy(frame.image).permute(2, 0, 1).float() / 255, frame.camera)


def clear(frame: SynthFrame) -> list[int]:
    """Rows of cars and trucks that are large and visible."""
    labels = frame.labels
    height = labels.boxes_xyxy[:, 3] - labels.boxes_xyxy[:, 1]
    good = (height >= 25) & (labels.occlusion <= 1) & (labels.truncation <= 0.3)
    return [i for i in range(len(labels.kind)) if labels.kind[i] in ("Car", "Van", "Truck") and bool(good[i])]


def test_shipped_weights_match_their_card(streets: list[SynthFrame]) -> None:
    turn, depth, size, kind = [], [], [], []
    for street in streets:
        labels, rows = street.labels, clear(street)
        kinds = ["Truck" if labels.kind[i] == "Truck" else "Car" for i in rows]
        found = pose.estimate_poses(plain(street).photograph, labels.boxes_xyxy[rows], kinds, street.camera)
        turn += [
            abs(math.remainder(float(a - b), 2 * math.pi))
            for a, b in zip(found.yaw, labels.yaw[rows], strict=False)
        ]
        depth += (found.translation[:, 2] / labels.translation[rows, 2] - 1).abs().tolist()
        size += (found.size_lhw / labels.size_lhw[rows]).log().abs().tolist()
        true = [t.actor.kind for t in street.truths if t.labelled]
        kind += [a == true[i] for a, i in zip(found.kind, rows, strict=True)]
    assert len(turn) >= 12
    assert math.degrees(float(np.median(turn))) < 4
    assert float(np.median(depth)) < 0.05
    assert np.median(size, 0).tolist() < [0.10, 0.06, 0.06]
    assert np.mean(np.array(turn) > math.pi / 2) < 0.15
    assert np.mean(kind) > 0.6


def test_found_vehicles_are_placed(streets: list[SynthFrame]) -> None:
    near = []
    for street in streets[:3]:
        frame = plain(street)
        found = label_from_detections(frame, detect(frame)).labels
        assert found is not None
        places = found.translation[[i for i, kind in enumerate(found.kind) if kind in ("Car", "Truck")]]
        for row in clear(street):
            true = street.labels.translation[row]
            apart = (places - true).norm(dim=1).min() if len(places) else torch.tensor(math.inf)
            near.append(float(apart / true[2]) < 0.15)
    assert np.mean(near) > 0.5


def test_a_larger_picture_of_the_same_street_gives_the_same_cars(streets: list[SynthFrame]) -> None:
    frame = plain(streets[0])
    k = frame.camera.intrinsics.clone()
    k[:2] *= 2
    k[:2, 2] += 0.5
    height, width = frame.photograph.shape[1:]
    large = torch.nn.functional.interpolate(frame.photograph[None], scale_factor=2, mode="bilinear")[0]
    one, two = detect(frame), detect(Frame("two", large, Camera(k, 2 * height, 2 * width)))
    assert len(one) > 0
    assert len(two) == pytest.approx(len(one), abs=max(1, len(one) // 3))
    sides = (two.boxes_xyxy[0, 2:] - two.boxes_xyxy[0, :2]) / 2
    apart = (one.boxes_xyxy - (two.boxes_xyxy[0] - 0.5) / 2).abs().amax(1).min()
    assert float(apart) < 0.25 * float(sides.max())


def boxed(frame: Frame, kind: tuple[str, ...], boxes: list[list[float]], **known: torch.Tensor) -> Frame:
    """The frame with labels that say 2D boxes, and what else is `known`."""
    count = len(kind)
    labels = Labels(
        kind=kind,
        boxes_xyxy=torch.tensor(boxes),
        truncation=known.get("truncation", torch.full((count,), math.nan)),
        occlusion=known.get("occlusion", torch.full((count,), 3, dtype=torch.int64)),
        translation=torch.full((count, 3), math.nan),
        yaw=torch.full((count,), math.nan),
        size_lhw=torch.full((count, 3), math.nan),
        ignore_xyxy=torch.tensor([[1.0, 2.0, 30.0, 40.0]]),
    )
    return replace(frame, labels=labels)


def test_labelled_boxes_are_placed_and_stay() -> None:
    boxes = [
        [600.0, 180.0, 700.0, 240.0],
        [50.0, 150.0, 90.0, 260.0],
        [300.0, 100.0, 300.0, 140.0],
        [5.0, 5.0, 90.0, 60.0],
    ]
    frame = boxed(frame_of(), ("car", "person", "truck", "dog"), boxes)
    assert frame.labels is not None
    assert not has_poses(frame.labels)
    labels = estimate_label_poses(frame).labels
    assert labels is not None
    assert has_poses(labels)
    assert labels.kind == ("Car", "Pedestrian", "Truck", "dog")
    assert torch.equal(labels.boxes_xyxy, frame.labels.boxes_xyxy)
    assert torch.equal(labels.ignore_xyxy, frame.labels.ignore_xyxy)
    known = torch.isfinite(labels.translation).all(1)
    assert known.tolist()[2:] == [False, False]  # a box without area, and what is no road user
    assert bool(known[0])
    assert 5 < float(labels.translation[0, 2]) < 60
    assert int(labels.occlusion[0]) == 0
    assert 0 <= float(labels.truncation[0]) < 0.2
    assert estimate_label_poses(frame).provenance["places"] == "estimated"


def test_a_rider_stands_where_the_wheels_do() -> None:
    car, rider, bicycle, cyclist = (
        [600.0, 180.0, 700.0, 240.0],
        [50.0, 150.0, 90.0, 240.0],
        [45.0, 200.0, 95.0, 260.0],
        [45.0, 150.0, 95.0, 260.0],
    )
    apart = boxed(frame_of(), ("car", "rider", "bicycle"), [car, rider, bicycle])
    together = boxed(frame_of(), ("car", "cyclist"), [car, cyclist])
    one, other = (estimate_label_poses(frame).labels for frame in (apart, together))
    assert one is not None
    assert other is not None
    assert one.boxes_xyxy[1].tolist() == rider
    assert torch.equal(one.translation[1], other.translation[1])


def test_known_labels_are_not_estimated() -> None:
    expected = {"truncation": torch.tensor([0.4]), "occlusion": torch.tensor([1])}
    labels = estimate_label_poses(boxed(frame_of(), ("Car",), [[600.0, 180.0, 700.0, 240.0]], **expected)).labels
    assert labels is not None
    assert (float(labels.truncation[0]), int(labels.occlusion[0])) == (pytest.approx(0.4), 1)


def test_of_two_cars_in_one_place_the_larger_stays() -> None:
    boxes = [[602.0, 182.0, 698.0, 239.0], [600.0, 180.0, 700.0, 240.0]]
    labels = estimate_label_poses(boxed(frame_of(), ("car", "car"), boxes)).labels
    assert labels is not None
    assert torch.isfinite(labels.translation[:, 2]).tolist() == [False, True]
    assert bool(torch.isnan(labels.size_lhw[0]).all())


def test_derender_takes_a_photograph(
    streets: list[SynthFrame], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Image.fromarray(streets[0].image).save(tmp_path / "street.png")
    focal = float(streets[0].camera.intrinsics[0, 0])
    words = ["derender", str(tmp_path / "street.png"), "--focal", str(focal), "--fast", "--json", "--workers", "1"]
    assert main([*words, "--out", str(tmp_path / "S")]) == 0
    captured = capsys.readouterr()
    assert f"focal length {focal:.0f} px (given)" in captured.err
    expected = json.loads(captured.out)["frames"]["street"]
    scene = load_scene(tmp_path / "S" / "street")
    assert expected["objects"] == len(scene.objects) > 0
    assert scene.provenance["labels"] == "estimated"
    assert torch.equal(
        (scene.photograph * 255).round().byte(), torch.from_numpy(streets[0].image).permute(2, 0, 1)
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none.png"], "none.png: expected a readable file"),
        (["a.txt"], "a.txt: expected an image"),
        (["none.png", "--dataset", "kitti", "--root", "."], "PHOTO: expected no --dataset, found"),
        (["--focal", "700"], "--focal: expected --dataset coco, yolo, voc, bdd100k, photographs"),
        (["none.png", "--focal", "-1"], "--focal: expected positive px"),
    ],
)
def test_derender_refuses_photographs(
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.txt").write_text("text")
    assert main(["derender", *words]) == 2
    assert message in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.skipif(not (KITTI / "training" / "label_2").is_dir(), reason="../shared/data/kitti is not there")
def test_cars_of_real_photographs_are_placed() -> None:
    dataset = open_dataset("kitti", KITTI)
    assert isinstance(dataset, KittiDataset)
    turn, depth = [], []
    for identifier in ("000003", "000008", "000010"):
        frame = dataset.frame(identifier)
        labels = frame.labels
        assert labels is not None
        rows = [i for i, k in enumerate(labels.kind) if k == "Car" and int(labels.occlusion[i]) <= 1]
        found = pose.estimate_poses(frame.photograph, labels.boxes_xyxy[rows], ["Car"] * len(rows), frame.camera)
        turn += [
            abs(math.remainder(float(a - b), math.pi)) for a, b in zip(found.yaw, labels.yaw[rows], strict=False)
        ]
        depth += (found.translation[:, 2] / labels.translation[rows, 2] - 1).abs().tolist()
    assert math.degrees(float(np.median(turn))) < 10  # front or back apart
    assert float(np.median(depth)) < 0.12
