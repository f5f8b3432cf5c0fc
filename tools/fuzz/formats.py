"""The fuzzed formats: for each a small valid folder, and the readers that the commands use."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import trimesh

from detectors.adapters.onnx import OnnxPredictor
from detectors.adapters.spec import load_spec
from detectors.registry import load_detector, save_detector
from detectors.yolov3 import darknet
from detectors.yolov3.cfg import CfgSection, build
from detectors.yolov3.yolov3 import YoloV3
from drivesem.analysis.transfer import (
    EVALUATED_PICTURES,
    FrameLosses,
    SourceRun,
    TransferCounts,
    TransferTarget,
)
from drivesem.analysis.verify import THETA, CheckLog, check_change
from drivesem.attacks.budgets import parse_budget
from drivesem.attacks.space import Parameter, ParameterSpace, parse_params
from drivesem.attacks.targets import EvaluatedClasses
from drivesem.config.commands import AttackConfig, ReportConfig
from drivesem.config.edits import read_edits, read_frame_edit
from drivesem.config.options import to_yaml
from drivesem.config.parsing import parse
from drivesem.data import kitti
from drivesem.data.ground_truth import SKY_CM, Exposure, FrameLocation, TrackedObject
from drivesem.data.layouts import read_table
from drivesem.data.photographs import read_photograph
from drivesem.data.registry import DATASETS, WRITERS, write_table
from drivesem.evaluation.matched_class import ThresholdMatches
from drivesem.run.finished import load_run
from drivesem.run.frame import summarise_frames
from drivesem.run.results import BoxRecord, Coordinate, Failure, FrameResult, RunSummary, dump_frame, load_frame
from drivesem.run.run_report import build_reports
from drivesem.scenes.segmenter import OnnxSegmenter
from scene_ir import files
from scene_ir.io import load_scene, save_scene
from scene_ir.meshes.load import import_mesh, save_mesh
from scene_ir.types import WEATHER_DIM, Camera, Crop, Environment, Labels, Mesh, Objects, Occluder, SceneIR, Source
from tools.experiments.classification.features import PIXEL_ATTACKS
from tools.experiments.classification.results import ClassificationResults, StudyFacts, StudyNetwork, save_results
from tools.experiments.classification.study import run_classification_study
from tools.experiments.detection.arms import AttackArm, AttackTotals
from tools.experiments.detection.counts import ArmCounts, DetectedObject, FailureRecord, FrameCounts, StudyCounts
from tools.experiments.detection.retraining_arms import BENIGN, build_retraining_arms
from tools.experiments.detection.retraining_results import BenignMatches, RetrainingCounts
from tools.experiments.detection.robustness import KINDS, FailureCounts, FrameStateCounts
from tools.experiments.detection.stored_results import save_retraining, save_study, save_transfer
from tools.experiments.detection.study import run_study
from tools.experiments.detection.transfer import TransferSource, TransferStudyCounts
from tools.experiments.realism import weights as realism_weights
from tools.experiments.settings import StudyConfig
from tools.experiments.survey.page import SurveyItem, read_answers, read_key, write_key
from tools.onnx_graph import constant_graph

SIZE_HW = (40, 80)
CLASSES = ("Undefined", "Sky", "Road", "Car")


@dataclass(frozen=True, slots=True)
class Format:
    """A file format to fuzz."""

    name: str
    """Name on the command line."""
    make: Callable[[Path], object]
    """Writes a valid folder."""
    read: Callable[[Path], object]
    """Reads such a folder as the commands do."""
    files: tuple[str, ...] = ("**/*",)
    """Globs of the files to damage."""
    share: float = 1.0
    """Inputs relative to other formats; slow formats get fewer."""


# ---- valid folders ----


def exposure() -> Exposure:
    """A road with two cars, one of them truncated by the image border; SIZE_HW."""
    rng = np.random.default_rng(0)
    boxes = ((10, 14, 27, 24), (60, 15, 79, 39))
    instances, classes = np.zeros(SIZE_HW, np.uint16), np.full(SIZE_HW, 2, np.uint8)
    classes[:10] = 1
    depth = rng.integers(300, 6000, SIZE_HW).astype(np.uint16)
    depth[:10] = SKY_CM
    objects = []
    for track, (left, top, right, bottom) in enumerate(boxes):
        instances[top : bottom + 1, left : right + 1] = track + 1
        classes[top : bottom + 1, left : right + 1] = 3
        place = (1.0 + 3 * track, 1.65, 14.5)
        objects.append(
            TrackedObject(
                track=track,
                kind="Car",
                model=f"car{track}",
                paint="red",
                moving=False,
                box_ltrb=(left, top, right, bottom),
                pixels=90,
                truncation=0.25 * track,
                visible=0.95,
                occlusion=0,
                translation=place,
                yaw=-1.25,
                size_lhw=(4.125, 1.5, 1.75),
                world=place,
                world_yxz=(-1.25, 0.0, 0.0),
                labelled=True,
            )
        )
    labels = Labels(
        kind=("Car", "Car"),
        boxes_xyxy=torch.tensor(boxes, dtype=torch.float32),
        truncation=torch.tensor([0.0, 0.25]),
        occlusion=torch.zeros(2, dtype=torch.int64),
        translation=torch.tensor([t.translation for t in objects]),
        yaw=torch.full((2,), -1.25),
        size_lhw=torch.tensor([t.size_lhw for t in objects]),
        ignore_xyxy=torch.tensor([[40.0, 12.0, 44.0, 18.0]]),
    )
    camera = Camera(torch.tensor([[72.5, 0, 39.5], [0, 72.5, 18.25], [0, 0, 1]]), *SIZE_HW)
    image = rng.integers(0, 256, (*SIZE_HW, 3), dtype=np.uint8)
    return Exposure(image, depth, classes, CLASSES, instances, camera, np.eye(4), tuple(objects), labels)


def dataset(layout: str, root: Path) -> None:
    place, writer = FrameLocation(1, "01", "clone", 1, "train"), WRITERS[layout](root)
    writer.finish([writer.write(place, exposure())])


def _vkitti1(root: Path) -> None:
    """A data set with the fixed picture size of this layout: 1242x375."""
    small = exposure()
    camera = Camera(torch.tensor([[725.0, 0, 620.5], [0, 725.0, 187.0], [0, 0, 1]]), 375, 1242)

    def pad(image: np.ndarray) -> np.ndarray:
        padded = np.zeros((375, 1242, *image.shape[2:]), image.dtype)
        padded[: SIZE_HW[0], : SIZE_HW[1]] = image
        return padded

    padded_exposure = replace(
        small,
        image=pad(small.image),
        depth_cm=pad(small.depth_cm),
        classes=pad(small.classes),
        instances=pad(small.instances),
        camera=camera,
    )
    place, writer = FrameLocation(1, "01", "clone", 1, "train"), WRITERS["vkitti1"](root)
    writer.finish([writer.write(place, padded_exposure)])


def box_mesh() -> Mesh:
    """A box of unit size, as vehicle meshes have."""
    box = trimesh.creation.box()
    vertices = torch.tensor(box.vertices, dtype=torch.float32) - torch.tensor([0.0, 0.5, 0.0])
    count = len(box.faces)
    colours = torch.full((len(vertices), 3), 0.5)
    return Mesh(vertices, torch.tensor(box.faces), torch.zeros(count, dtype=torch.int64), "box", colours)


def scene() -> SceneIR:
    """A scene of one car with every optional part of a scene folder."""
    height, width = SIZE_HW
    camera = Camera(torch.tensor([[72.5, 0, 39.5], [0, 72.5, 18.25], [0, 0, 1]]), height, width)
    place, size, lattice = torch.tensor([0.0, 1.65, 14.0]), torch.tensor([4.0, 1.5, 1.75]), torch.zeros(64, 3)
    source = Source(
        translation=place,
        yaw=torch.tensor(-1.25),
        size_lhw=size,
        ffd=lattice,
        foreground=Crop(torch.full((4, 10, 12), 0.5), 30, 15),
        shadow=Crop(torch.full((3, 4, 12), 0.5), 30, 25),
        inflation=0.1,
        paint=torch.full((3,), 0.5),
        sunlight=0.5,
        region=Crop(torch.full((1, 10, 12), 0.5), 30, 15),
    )
    objects = Objects(
        mesh_index=torch.zeros(1, dtype=torch.int64),
        translation=place[None],
        yaw=torch.full((1,), -1.25),
        size_lhw=size[None],
        ffd=lattice[None],
        texture_code=torch.zeros(1, 5),
        category=torch.zeros(1, dtype=torch.int64),
        box2d=torch.tensor([[30.0, 15.0, 41.0, 24.0]]),
        truncation=torch.zeros(1),
        occlusion=torch.zeros(1, dtype=torch.int64),
        source=(source,),
    )
    empty = torch.zeros(height, width)
    ground, sun = torch.tensor([0.0, -1.0, 0.0, 1.65]), torch.tensor([0.0, -1.0, 0.0])
    environment = Environment(torch.zeros(WEATHER_DIM), torch.zeros(3), sun, ground, empty, empty, empty + 1)
    picture = torch.from_numpy(exposure().image).permute(2, 0, 1).float() / 255
    occluders = (Occluder(Crop(torch.full((4, 3, 3), 0.5), 1, 1), 9.0),)
    depth, ignore = torch.full((height, width), 80.0), torch.tensor([[1.0, 2.0, 3.0, 4.0]])
    return SceneIR(
        camera,
        (box_mesh(),),
        objects,
        environment,
        picture,
        picture,
        depth,
        ignore,
        {"dataset": "made"},
        occluders,
    )


def _run(root: Path) -> None:
    """A run of one frame: its files, and metrics computed from them."""
    picture = exposure().image
    space = ParameterSpace(scene(), _PARAMS)
    theta = tuple(
        Coordinate(space.name(i), "m", 0.0, float(space.lower[i]), float(space.upper[i]), "+0.00 m")
        for i in range(space.dim)
    )
    box, moved = (30.0, 15.0, 41.0, 24.0), (33.0, 15.0, 44.0, 24.0)
    detections = (BoxRecord(box, "Car", score=0.9),)
    result = FrameResult(
        identifier="a",
        objects=1,
        queries=3,
        loss_trace=(0.5, 1.0, 2.0),
        theta=theta,
        active_constraints=("ground",),
        violations=(),
        targets_benign=(BoxRecord(box, "Car", index=0),),
        targets_moved=(BoxRecord(moved, "Car", index=0),),
        detections_benign=detections,
        detections_rerendered=detections,
        detections_attacked=(),
        failures=(Failure("lost", "Car", moved, 0, 0.9, "missed", "threshold"),),
        became_ignored=(),
        judged=(0,),
        found_before=(0,),
        success_paper=True,
        success_moved=True,
        identity_psnr_db=None,
        seconds=0.5,
        passes=9,
    )
    frame = root / "frames" / "a"
    for name in ("benign", "rerender", "counterexample", "overlay"):
        files.write_png(frame / f"{name}.png", picture)
    files.write_text(frame / "result.json", dump_frame(result))
    coordinates = {
        c.name: {"value": c.value, "unit": c.unit, "bounds": [c.lower, c.upper], "display": c.display}
        for c in theta
    }
    files.write_json(frame / THETA, coordinates)
    files.write_text(root / "config.yaml", to_yaml(AttackConfig(params="translate,rotate")))
    metrics = summarise_frames([result], EvaluatedClasses(("Car",), ("Car",)), 0.5, "Car")
    summary = RunSummary(
        out="run",
        dataset="demo",
        params=("translate", "rotate"),
        detector="squeezedet",
        headline="Car",
        t_star=0.5,
        frames_without_vehicles=0,
        frames_failed={},
        seconds=1.0,
        **metrics,
    )
    files.write_json(root / "metrics.json", summary.to_json())
    files.write_json(root / "manifest.json", {"versions": {}, "seed": 0, "settings": {}, "frames": {"a": {}}})


_PARAMS: tuple[Parameter, ...] = tuple(parse_params("translate,rotate"))


def _run_with_scene(root: Path) -> None:
    _run(root)
    save_scene(scene(), root / "scene")


def net() -> YoloV3:
    """A Darknet network of two layers."""
    layers = [
        CfgSection("net", {"height": "32", "width": "32", "channels": "3"}),
        CfgSection(
            "convolutional", {"filters": "4", "size": "3", "stride": "2", "pad": "1", "activation": "leaky"}
        ),
        CfgSection("route", {"layers": "-1"}),
        CfgSection("convolutional", {"filters": "12", "size": "1", "stride": "1", "activation": "linear"}),
        CfgSection("yolo", {"mask": "0,1", "anchors": "10,13, 16,30", "classes": "1", "num": "2"}),
    ]
    return YoloV3(("Car",), cfg=build(layers))


def _cloud() -> bytes:
    return np.random.default_rng(0).uniform(-5, 20, (50, 4)).astype("<f4").tobytes()


def _kitti(root: Path) -> None:
    dataset("kitti", root)
    files.write_bytes(root / "training" / "velodyne" / "000001.bin", _cloud())


def _pictures(root: Path) -> None:
    example = exposure()
    files.write_png(root / "image.png", example.image)
    files.write_png(root / "depth.png", example.depth_cm)
    _, encoded = cv2.imencode(".jpg", example.image)
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x02" + b"\x01\x12\0\x03\0\0\0\x01\0\x06\0\0"  # turned by 90 degrees
    exif += b"\x92\x0a\0\x05\0\0\0\x01\0\0\0&\0\0\0\0" + b"\0\0\0\x32\0\0\0\x01"  # focal length 50/1 mm
    jpeg = encoded.tobytes()
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    files.write_bytes(root / "photo.jpg", jpeg[:2] + segment + jpeg[2:])


def _meshes(root: Path) -> None:
    box: Any = trimesh.creation.box((4.0, 1.5, 1.75))
    box.visual.vertex_colors = np.full((len(box.vertices), 4), 200, np.uint8)
    for suffix in ("ply", "glb", "obj", "gltf"):
        exported: Any = (trimesh.Scene(box) if suffix in ("glb", "gltf") else box).export(file_type=suffix)
        contents = exported if isinstance(exported, dict) else {f"a.{suffix}": exported}
        for name, content in contents.items():
            data = content if isinstance(content, bytes) else content.encode()
            files.write_bytes(root / name.replace("model", "a"), data)
    files.write_bytes(root / "text.ply", box.export(file_type="ply", encoding="ascii"))
    painted = "mtllib a.mtl\nusemtl body\n" + (root / "a.obj").read_text()
    files.write_text(root / "a.obj", painted)
    files.write_text(root / "a.mtl", "newmtl body\nKd 0.5 0.5 0.5\nmap_Kd image.png\n")
    files.write_png(root / "image.png", exposure().image)
    save_mesh(box_mesh(), root / "own.glb")


def _survey(root: Path) -> None:
    item = SurveyItem("0123abcd", "counterexample", "run", "rotate", "a", 0, "Car")
    write_key(root / "key.json", [item], {"seed": 0})
    name = read_key(root / "key.json")[0]
    head = "survey,participant,item,position,named,realism,seconds"
    files.write_text(root / "answers.csv", f"{head}\n{name},me,0123abcd,1,Car,7,3.5\n")


def _arm_counts() -> tuple[ThresholdMatches, ArmCounts]:
    """The matches of one picture, and the counts of an arm of one frame."""
    marks = np.array([[1] * 10, [0] * 9 + [2]])
    matches = ThresholdMatches(np.zeros(2, np.int64), np.array([0.75, 0.8]), marks, np.ones(1))
    lost = FailureRecord(0, "missed", "certain", True)
    frame = FrameCounts("a", 10, 30, 1.5, True, True, True, 0.5, 2, (lost,))
    return matches, ArmCounts(
        AttackArm("rotate", "rotate", AttackConfig()), (frame,), matches, {"paper": matches, "moved": matches}
    )


def _arm_study(root: Path) -> None:
    """Stored results of a study of one arm and frame."""
    objects = {"a": (DetectedObject(0, 30.0, 12.0),)}
    counts = StudyCounts((_arm_counts()[1],), 1, {"b": "no camera"}, objects)
    save_study(root, StudyConfig(name="single"), counts, {})
    _unpack(root)


def _pair(source: str, target: str) -> TransferCounts:
    matches = _arm_counts()[0]
    losses = FrameLosses("a", 2, 1, 1, 1, 1, 1, True, True, 1)
    pictures = {name: {"Car": matches} for name in EVALUATED_PICTURES}
    run = SourceRun(source, "squeezedet", "si-fgsm", "rotate")
    return TransferCounts(run, TransferTarget(target, target, ("Car",), 0.5), (losses,), pictures)


def _transfer_study(root: Path) -> None:
    source = TransferSource("squeezedet", "placebo", {"squeezedet": (0.994, 0.659)})
    pairs = [_pair(name, "squeezedet") for name in ("squeezedet", "placebo")]
    counts = TransferStudyCounts(
        AttackTotals(1, 2, 2, 1, {"b": "no camera"}), (source,), pairs, {"a.png": "cut off"}
    )
    save_transfer(root, StudyConfig(name="transfer"), counts)
    _unpack(root)


def _retraining_study(root: Path) -> None:
    study = StudyConfig(name="retrain", arms="benign", quick=True)
    names = [BENIGN, *(arm.name for arm in build_retraining_arms(study))]
    matches, arm = _arm_counts()
    states = FrameStateCounts("a", "", {kind: FailureCounts(4, (2, 1), 3, (0, 1)) for kind in KINDS}, "")
    counts = RetrainingCounts(
        attack="combo 2",
        training_attacks=AttackTotals(1, 1, 1, 0, {}),
        test_attacks=AttackTotals(1, 2, 2, 0, {}),
        counterexamples={names[1]: 1},
        benign_training_frames=1,
        benign_frames=("a",),
        benign_matches={name: BenignMatches(matches, 0.5) for name in names},
        known=[_pair(BENIGN, name) for name in names],
        fresh=[replace(arm, arm=replace(arm.arm, name=name)) for name in names],
        left_out={"ours": "none"},
        states=[states],
    )
    save_retraining(root, study, counts)
    _unpack(root)


def _classification_study(root: Path) -> None:
    facts = StudyFacts(
        settings=StudyConfig(name="classification", quick=True),
        classes=("box", "ball"),
        networks=(StudyNetwork("one", "vgg16"),),
        tables=("pixels", "sizes"),
        measures=("psnr",),
        distance="perceptual",
        toolbox=True,
        pictures=("box/0", "ball/0"),
        retested=(0,),
        counts={"test": 2, "train": 0, "retrained": 1},
        objects={split: {"box": 1, "ball": 1} for split in ("train", "val", "test")},
        used={split: {"box": 1, "ball": 1} for split in ("test", "train")},
        failed={},
    )
    results = ClassificationResults(facts)
    for attack in PIXEL_ATTACKS:
        results.correct["pixels", "one", attack, ""] = np.array([True, False])
        results.distances["pixels", "one", attack, ""] = np.array([0.25, 0.5])
    save_results(root, results)
    _unpack(root)


def _unpack(root: Path) -> None:
    """Store packed tables as text too, so that single cells are damaged."""
    for path in root.rglob("*.gz"):
        files.write_bytes(path.with_suffix(""), files.read_gzip(path))


def _weights(root: Path) -> None:
    save_detector(net(), root / "net.safetensors")


def _states(root: Path) -> None:
    root.mkdir()
    torch.save({"layer.weight": torch.ones(4, 4), "layer.bias": torch.ones(4)}, root / "state.pth")


def _graphs(root: Path) -> None:
    names = {"names": "{0: 'car', 1: 'person'}"}
    boxes = np.zeros((1, 6, 21), np.float32)
    files.write_bytes(root / "graph.onnx", constant_graph((1, 3, 32, 32), {"output0": boxes}, names))
    classes = np.zeros((1, 2, 8, 8), np.float32)
    metadata = {"classes": '["road", "car"]', "mean": "[0.5, 0.5, 0.5]", "std": "[1, 1, 1]"}
    files.write_bytes(root / "segmenter.onnx", constant_graph((1, 3, 32, 32), {"output0": classes}, metadata))


def _settings(root: Path) -> None:
    files.write_text(
        root / "preset.yaml", "for: attack\nparams: translate,rotate\nsteps: 5\nlimit: 3\nwhole: true\n"
    )
    files.write_text(
        root / "edit.yaml", "weather: {fog: 0.5}\nobjects: {2: {translate: [0.5m, 0m], rotate: 10deg}}\n"
    )
    files.write_text(
        root / "edits.yaml", "frames: {all: {foliage: {hue: 0.4}}, 3: {objects: {all: {size: 5%}}}}\n"
    )
    files.write_text(
        root / "spec.yaml", "size: [32, 64]\nmean: [0.5, 0.5, 0.5]\nclasses: [Car, '-']\nt_star: 0.5\n"
    )
    files.write_text(root / "budget.yaml", "translate: 0.1m\nweather: 0.5\n")


# ---- readers ----


def call_all(*readers: Callable[[Path], object]) -> Callable[[Path], object]:
    """Call all readers, also after one refuses the file; then raise the first error."""

    def read(root: Path) -> None:
        refused: Exception | None = None
        for reader in readers:
            try:
                reader(root)
            except ValueError as error:
                refused = _first_own_error(refused, error)
        if refused is not None:
            raise refused

    return read


def _first_own_error(first: Exception | None, error: Exception) -> Exception:
    """The first of two of the project's errors; raises any other error."""
    if type(error).__name__ not in OWN_ERRORS:
        raise error
    return first or error


OWN_ERRORS = ("FormatError", "RangeError", "ShapeError", "DetectorError", "UsageError", "WriteError")
"""Errors that a damaged file may raise."""


def _frames(layout: str, root: Path) -> None:
    dataset = DATASETS[layout](root)
    for name in dataset.identifiers[:3]:
        call_all(lambda _, name=name: dataset.labels(name), lambda _, name=name: dataset.frame(name))(root)


def _table(layout: str, root: Path) -> None:
    """Read the labels, and write them in every layout as `convert` does."""
    table = read_table(root, layout)
    for to in ("kitti", "coco", "yolo"):
        try:
            write_table(table, root.parent / "converted" / to, to, {})
        except ValueError as error:
            _first_own_error(None, error)


def _read_meshes(names: Sequence[str], root: Path) -> None:
    call_all(*(lambda root, name=name: import_mesh(root / name) for name in names))(root)


def _read_pictures(root: Path) -> None:
    files.read_image(root / "image.png")
    files.read_uint16(root / "depth.png", SIZE_HW)


def _check_theta(root: Path) -> None:
    base = load_scene(root / "scene")
    frame = root / "frames" / "a"
    budget = parse_budget("paper")
    check_change(
        CheckLog(), frame, load_frame(frame / "result.json"), base.unperturbed(), base, _PARAMS, budget, "ground"
    )


def _segment(root: Path) -> None:
    OnnxSegmenter(root / "segmenter.onnx")(np.zeros((*SIZE_HW, 3), np.float32))


def _predict(root: Path) -> None:
    predictor = OnnxPredictor(root / "graph.onnx")
    predictor.decode(predictor.forward(torch.zeros(1, 3, *SIZE_HW)))


def _read_answers(root: Path) -> None:
    name, items = read_key(root / "key.json")
    read_answers(root / "answers.csv", name, items)


def _report_study(root: Path, name: str) -> None:
    for path in root.rglob("*.gz"):
        files.write_bytes(path, gzip.compress(path.with_suffix("").read_bytes()))
    run = run_classification_study if name == "classification" else run_study
    run(StudyConfig(name=name, results=str(root), bootstrap=0))


def _report(root: Path) -> None:
    build_reports(ReportConfig(runs=(str(root),), frames=1, out=str(root.parent / "report.html")))


def _load_and_detect(root: Path) -> None:
    detector = load_detector(root / "net.safetensors")
    detector.decode(detector(torch.zeros(1, 3, 32, 64)))


def _detect_with_darknet(root: Path) -> None:
    detector = darknet.load(root / "net.cfg")
    detector.decode(detector(torch.zeros(1, 3, 32, 64)))


_STORED_STUDIES: dict[str, Callable[[Path], None]] = {
    "single": _arm_study,
    "transfer": _transfer_study,
    "retrain": _retraining_study,
    "classification": _classification_study,
}
FORMATS: dict[str, Format] = {
    form.name: form
    for form in (
        Format(
            "kitti labels",
            _kitti,
            call_all(
                lambda root: kitti.read_labels(root / "training" / "label_2" / "000001.txt"),
                partial(_table, "kitti"),
                partial(_frames, "kitti"),
            ),
            ("**/label_2/*.txt",),
        ),
        Format("kitti calib", _kitti, partial(_frames, "kitti"), ("**/calib/*.txt",)),
        Format("kitti images", _kitti, partial(_frames, "kitti"), ("**/*.png",)),
        Format(
            "png and jpeg",
            _pictures,
            call_all(
                _read_pictures,
                lambda root: read_photograph(root / "photo.jpg"),
                lambda root: read_photograph(root / "image.png"),
            ),
        ),
        Format(
            "virtual kitti 1",
            _vkitti1,
            call_all(partial(_frames, "vkitti1"), partial(_table, "vkitti1")),
            ("**/*.txt",),
            share=0.25,
        ),
        Format(
            "virtual kitti 2",
            partial(dataset, "vkitti2"),
            call_all(partial(_frames, "vkitti2"), partial(_table, "vkitti2")),
        ),
        Format(
            "coco json",
            partial(dataset, "coco"),
            call_all(partial(_frames, "coco"), partial(_table, "coco")),
            ("**/*.json",),
        ),
        Format("yolo", partial(dataset, "yolo"), call_all(partial(_frames, "yolo"), partial(_table, "yolo"))),
        Format("scene folder", partial(save_scene, scene()), load_scene),
        Format("run", _run, call_all(load_run, _report), ("*.json", "*.yaml", "**/*.json", "**/*.png"), share=0.1),
        Format("theta.json", _run_with_scene, _check_theta, ("frames/a/*.json",)),
        Format(
            "settings yaml",
            _settings,
            call_all(
                lambda root: parse(["attack", "--config", str(root / "preset.yaml")]),
                lambda root: read_frame_edit(root / "edit.yaml"),
                lambda root: read_edits(root / "edits.yaml"),
                lambda root: load_spec(root / "spec.yaml"),
                lambda root: parse_budget(str(root / "budget.yaml")),
            ),
            share=0.25,
        ),
        Format("darknet", lambda root: darknet.save(net(), root / "net.cfg"), _detect_with_darknet),
        Format("obj", _meshes, partial(_read_meshes, ("a.obj",)), ("a.obj", "a.mtl", "image.png")),
        Format(
            "glb", _meshes, partial(_read_meshes, ("a.glb", "own.glb", "a.gltf")), ("*.glb", "*.gltf", "*.bin")
        ),
        Format("ply", _meshes, partial(_read_meshes, ("a.ply", "text.ply")), ("*.ply",)),
        Format("safetensors", _weights, _load_and_detect),
        Format("state dict", _states, lambda root: realism_weights.read_weights(root / "state.pth")),
        Format("onnx", _graphs, call_all(_predict, _segment)),
        Format("survey", _survey, _read_answers),
        *(
            Format(
                f"stored {name}", make, partial(_report_study, name=name), ("**/*.json", "**/*.csv"), share=0.25
            )
            for name, make in _STORED_STUDIES.items()
        ),
    )
}
