"""What is fuzzed: for each format a small valid folder, and the readers that commands use of it."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
import trimesh

from detectors.adapters.onnx import OnnxPredictor
from detectors.adapters.spec import load_spec
from detectors.registry import load_detector, save_detector
from detectors.yolov3 import darknet
from detectors.yolov3.cfg import Section, build
from detectors.yolov3.yolov3 import YoloV3
from drivesem.analysis.transfer.matrix import SHOWN, FrameLosses, PairCounts, ShownRun, Target
from drivesem.analysis.verify.change import THETA, check_change
from drivesem.analysis.verify.differences import CheckLog
from drivesem.attack.budgets import budget_of
from drivesem.attack.judging import JudgedClasses
from drivesem.attack.space import Parameter, ParameterSpace, parse_params
from drivesem.config.commands import Attack, Report, Study
from drivesem.config.edits import read_edits, read_frame_edit
from drivesem.config.parsing import parse
from drivesem.config.text import to_yaml
from drivesem.data import kitti
from drivesem.data.layouts import read_table
from drivesem.data.photographs import photograph
from drivesem.data.registry import DATASETS, WRITERS, write_table
from drivesem.data.truth import SKY_CM, Exposure, Place, TrackedObject
from drivesem.evaluation.matches import Matches
from drivesem.run.finished import load_run
from drivesem.run.page import report_runs
from drivesem.run.results import BoxRecord, Coordinate, Failure, FrameResult, RunSummary, dump_frame, load_frame
from drivesem.run.tally import tally
from drivesem.scenes.segmenter import OnnxSegmenter
from scene_ir import files
from scene_ir.io import load_scene, save_scene
from scene_ir.meshes.load import import_mesh, save_mesh
from scene_ir.types import Camera, Crop, Environment, Front, Labels, Mesh, Objects, SceneIR, Source
from tools.experiments.classification import pixels
from tools.experiments.classification.asking import study_run as classification_run
from tools.experiments.classification.kept import keep_results
from tools.experiments.classification.results import Facts, Network, Results
from tools.experiments.detection.arms import Arm
from tools.experiments.detection.asking import study_run
from tools.experiments.detection.counts import (
    ArmCounts,
    CountedFailure,
    FrameCounts,
    SeenObject,
    StudyCounts,
)
from tools.experiments.detection.kept import keep
from tools.experiments.detection.kept_retrain import keep_retrain
from tools.experiments.detection.kept_transfer import keep_transfer
from tools.experiments.detection.lessons import BENIGN, lessons_of
from tools.experiments.detection.robust import KINDS, Counted, FrameStates
from tools.experiments.detection.running import AttackFacts
from tools.experiments.detection.taught import RetrainCounts, SeenBenign
from tools.experiments.detection.transfer import AskedArm, TransferCounts
from tools.experiments.realism import weights as realism_weights
from tools.experiments.survey.page import Item, read_answers, read_key, write_key
from tools.onnx_graph import constant_graph

SIZE_HW = (40, 80)
CLASSES = ("Undefined", "Sky", "Road", "Car")


@dataclass(frozen=True, slots=True)
class Format:
    """make: writes a valid folder; read: the readers, of that folder; files: globs of what is damaged; share: of
    the inputs, against other formats: those that take long get fewer.
    """

    name: str
    make: Callable[[Path], object]
    read: Callable[[Path], object]
    files: tuple[str, ...] = ("**/*",)
    share: float = 1.0


# ---- valid folders ----


def exposure() -> Exposure:
    """A road with two cars, one of which is cut off by the image's edge; SIZE_HW."""
    rng = np.random.default_rng(0)
    boxes = ((10, 14, 27, 24), (60, 15, 79, 39))
    instances, classes = np.zeros(SIZE_HW, np.uint16), np.full(SIZE_HW, 2, np.uint8)
    classes[:10] = 1
    depth = rng.integers(300, 6000, SIZE_HW).astype(np.uint16)
    depth[:10] = SKY_CM
    things = []
    for track, (left, top, right, bottom) in enumerate(boxes):
        instances[top : bottom + 1, left : right + 1] = track + 1
        classes[top : bottom + 1, left : right + 1] = 3
        place = (1.0 + 3 * track, 1.65, 14.5)
        things.append(
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
        translation=torch.tensor([t.translation for t in things]),
        yaw=torch.full((2,), -1.25),
        size_lhw=torch.tensor([t.size_lhw for t in things]),
        ignore_xyxy=torch.tensor([[40.0, 12.0, 44.0, 18.0]]),
    )
    camera = Camera(torch.tensor([[72.5, 0, 39.5], [0, 72.5, 18.25], [0, 0, 1]]), *SIZE_HW)
    image = rng.integers(0, 256, (*SIZE_HW, 3), dtype=np.uint8)
    return Exposure(image, depth, classes, CLASSES, instances, camera, np.eye(4), tuple(things), labels)


def dataset(layout: str, root: Path) -> None:
    place, writer = Place(1, "01", "clone", 1, "train"), WRITERS[layout](root)
    writer.finish([writer.write(place, exposure())])


def _vkitti1(root: Path) -> None:
    """As the layout's own writer makes it, but for the size of its pictures, which is fixed: 1242x375."""
    small = exposure()
    camera = Camera(torch.tensor([[725.0, 0, 620.5], [0, 725.0, 187.0], [0, 0, 1]]), 375, 1242)

    def large(image: np.ndarray) -> np.ndarray:
        whole = np.zeros((375, 1242, *image.shape[2:]), image.dtype)
        whole[: SIZE_HW[0], : SIZE_HW[1]] = image
        return whole

    whole = replace(
        small,
        image=large(small.image),
        depth_cm=large(small.depth_cm),
        classes=large(small.classes),
        instances=large(small.instances),
        camera=camera,
    )
    place, writer = Place(1, "01", "clone", 1, "train"), WRITERS["vkitti1"](root)
    writer.finish([writer.write(place, whole)])


def box_mesh() -> Mesh:
    """A box of a vehicle's unit size."""
    box = trimesh.creation.box()
    vertices = torch.tensor(box.vertices, dtype=torch.float32) - torch.tensor([0.0, 0.5, 0.0])
    count = len(box.faces)
    colours = torch.full((len(vertices), 3), 0.5)
    return Mesh(vertices, torch.tensor(box.faces), torch.zeros(count, dtype=torch.int64), "box", colours)


def scene() -> SceneIR:
    """A scene of one car, with all that a folder can hold."""
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
    environment = Environment(torch.zeros(4), torch.zeros(3), sun, ground, empty, empty, empty + 1)
    picture = torch.from_numpy(exposure().image).permute(2, 0, 1).float() / 255
    front = (Front(Crop(torch.full((4, 3, 3), 0.5), 1, 1), 9.0),)
    depth, ignore = torch.full((height, width), 80.0), torch.tensor([[1.0, 2.0, 3.0, 4.0]])
    return SceneIR(
        camera, (box_mesh(),), objects, environment, picture, picture, depth, ignore, {"dataset": "made"}, front
    )


def _run(root: Path) -> None:
    """A run of one frame, by hand: its files, and figures that follow from them."""
    picture = exposure().image
    space = ParameterSpace(scene(), _PARAMS)
    theta = tuple(
        Coordinate(space.name(i), "m", 0.0, float(space.lower[i]), float(space.upper[i]), "+0.00 m")
        for i in range(space.dim)
    )
    box, moved = (30.0, 15.0, 41.0, 24.0), (33.0, 15.0, 44.0, 24.0)
    found = (BoxRecord(box, "Car", score=0.9),)
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
        detections_benign=found,
        detections_rerendered=found,
        detections_attacked=(),
        failures=(Failure("lost", "Car", moved, 0, 0.9, "missed", "threshold"),),
        became_ignored=(),
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
    told = {
        c.name: {"value": c.value, "unit": c.unit, "bounds": [c.lower, c.upper], "display": c.display}
        for c in theta
    }
    files.write_json(frame / THETA, told)
    files.write_text(root / "config.yaml", to_yaml(Attack(params="translate,rotate")))
    judged = JudgedClasses(("Car",), ("Car",))
    figures = tally([result], judged, 0.5, "Car")
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
        **figures,
    )
    files.write_json(root / "metrics.json", summary.to_json())
    files.write_json(root / "manifest.json", {"versions": {}, "seed": 0, "settings": {}, "frames": {"a": {}}})


_PARAMS: tuple[Parameter, ...] = tuple(parse_params("translate,rotate"))


def _run_with_scene(root: Path) -> None:
    _run(root)
    save_scene(scene(), root / "scene")


def net() -> YoloV3:
    """A Darknet of two layers."""
    layers = [
        Section("net", {"height": "32", "width": "32", "channels": "3"}),
        Section("convolutional", {"filters": "4", "size": "3", "stride": "2", "pad": "1", "activation": "leaky"}),
        Section("route", {"layers": "-1"}),
        Section("convolutional", {"filters": "12", "size": "1", "stride": "1", "activation": "linear"}),
        Section("yolo", {"mask": "0,1", "anchors": "10,13, 16,30", "classes": "1", "num": "2"}),
    ]
    return YoloV3(("Car",), cfg=build(layers))


def _cloud() -> bytes:
    return np.random.default_rng(0).uniform(-5, 20, (50, 4)).astype("<f4").tobytes()


def _kitti(root: Path) -> None:
    dataset("kitti", root)
    files.write_bytes(root / "training" / "velodyne" / "000001.bin", _cloud())


def _pictures(root: Path) -> None:
    shown = exposure()
    files.write_png(root / "image.png", shown.image)
    files.write_png(root / "depth.png", shown.depth_cm)
    _, encoded = cv2.imencode(".jpg", shown.image)
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x02" + b"\x01\x12\0\x03\0\0\0\x01\0\x06\0\0"  # turned by 90 degrees
    exif += b"\x92\x0a\0\x05\0\0\0\x01\0\0\0&\0\0\0\0" + b"\0\0\0\x32\0\0\0\x01"  # focal length 50/1 mm
    jpeg = encoded.tobytes()
    part = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    files.write_bytes(root / "photo.jpg", jpeg[:2] + part + jpeg[2:])


def _meshes(root: Path) -> None:
    box = trimesh.creation.box((4.0, 1.5, 1.75))
    box.visual.vertex_colors = np.full((len(box.vertices), 4), 200, np.uint8)
    for suffix in ("ply", "glb", "obj", "gltf"):
        told = (
            trimesh.Scene(box).export(file_type=suffix)
            if suffix in ("glb", "gltf")
            else box.export(file_type=suffix)
        )
        parts = told if isinstance(told, dict) else {f"a.{suffix}": told}
        for name, content in parts.items():
            data = content if isinstance(content, bytes) else content.encode()
            files.write_bytes(root / name.replace("model", "a"), data)
    files.write_bytes(root / "text.ply", box.export(file_type="ply", encoding="ascii"))
    painted = "mtllib a.mtl\nusemtl body\n" + (root / "a.obj").read_text()
    files.write_text(root / "a.obj", painted)
    files.write_text(root / "a.mtl", "newmtl body\nKd 0.5 0.5 0.5\nmap_Kd image.png\n")
    files.write_png(root / "image.png", exposure().image)
    save_mesh(box_mesh(), root / "own.glb")


def _survey(root: Path) -> None:
    item = Item("0123abcd", "counterexample", "run", "rotate", "a", 0, "Car")
    write_key(root / "key.json", [item], {"seed": 0})
    name = read_key(root / "key.json")[0]
    head = "survey,participant,item,position,named,realism,seconds"
    files.write_text(root / "answers.csv", f"{head}\n{name},me,0123abcd,1,Car,7,3.5\n")


def _counted() -> tuple[Matches, ArmCounts]:
    """An arm of one frame, and what is found in its pictures."""
    marks = np.array([[1] * 10, [0] * 9 + [2]])
    found = Matches(np.zeros(2, np.int64), np.array([0.75, 0.8]), marks, np.ones(1))
    lost = CountedFailure(0, "missed", "certain", True)
    frame = FrameCounts("a", 10, 30, 1.5, True, True, True, 0.5, 2, (lost,))
    return found, ArmCounts(Arm("rotate", "rotate", Attack()), (frame,), found, {"paper": found, "moved": found})


def _kept(root: Path) -> None:
    """What a study of one arm and frame keeps."""
    seen = {"a": (SeenObject(0, 30.0, 12.0),)}
    keep(root, Study(name="single"), StudyCounts((_counted()[1],), 1, {"b": "no camera"}, seen), {})
    _unpack(root)


def _pair(source: str, target: str) -> PairCounts:
    found = _counted()[0]
    losses = FrameLosses("a", 2, 1, 1, 1, 1, 1, True, True, 1)
    pictures = {name: {"Car": found} for name in SHOWN}
    shown = ShownRun(source, "squeezedet", "si-fgsm", "rotate")
    return PairCounts(shown, Target(target, target, ("Car",), 0.5), (losses,), pictures)


def _kept_transfer(root: Path) -> None:
    source = AskedArm("squeezedet", "placebo", {"squeezedet": (0.994, 0.659)})
    pairs = [_pair(name, "squeezedet") for name in ("squeezedet", "placebo")]
    counts = TransferCounts(AttackFacts(1, 2, 2, 1, {"b": "no camera"}), (source,), pairs, {"a.png": "cut off"})
    keep_transfer(root, Study(name="transfer"), counts)
    _unpack(root)


def _kept_retrain(root: Path) -> None:
    study = Study(name="retrain", arms="benign", quick=True)
    names = [BENIGN, *(lesson.name for lesson in lessons_of(study))]
    found, arm = _counted()
    states = FrameStates("a", "", {kind: Counted(4, (2, 1), 3, (0, 1)) for kind in KINDS}, "")
    counts = RetrainCounts(
        attack="combo 2",
        learned=AttackFacts(1, 1, 1, 0, {}),
        judged=AttackFacts(1, 2, 2, 0, {}),
        shown={names[1]: 1},
        benign=1,
        benign_frames=("a",),
        seen={name: SeenBenign(found, 0.5) for name in names},
        known=[_pair(BENIGN, name) for name in names],
        fresh=[replace(arm, arm=replace(arm.arm, name=name)) for name in names],
        left_out={"ours": "none"},
        states=[states],
    )
    keep_retrain(root, study, counts)
    _unpack(root)


def _kept_classification(root: Path) -> None:
    facts = Facts(
        study=Study(name="classification", quick=True),
        classes=("box", "ball"),
        networks=(Network("one", "vgg16", deep=True),),
        tables=("pixels", "sizes"),
        measures=("psnr",),
        distance="perceptual",
        toolbox=True,
        pictures=("box/0", "ball/0"),
        few=(0,),
        counts={"test": 2, "train": 0, "retrained": 1},
        objects={split: {"box": 1, "ball": 1} for split in ("train", "val", "test")},
        used={split: {"box": 1, "ball": 1} for split in ("test", "train")},
        failed={},
    )
    results = Results(facts)
    for attack in pixels.ATTACKS:
        results.right["pixels", "one", attack, ""] = np.array([True, False])
        results.distances["pixels", "one", attack, ""] = np.array([0.25, 0.5])
    keep_results(root, results)
    _unpack(root)


def _unpack(root: Path) -> None:
    """Packed tables as texts, too, so that their words are damaged."""
    for path in root.rglob("*.gz"):
        files.write_bytes(path.with_suffix(""), files.read_gzip(path))


def _weights(root: Path) -> None:
    save_detector(net(), root / "net.safetensors")


def _states(root: Path) -> None:
    root.mkdir()
    torch.save({"layer.weight": torch.ones(4, 4), "layer.bias": torch.ones(4)}, root / "state.pth")


def _graphs(root: Path) -> None:
    facts = {"names": "{0: 'car', 1: 'person'}"}
    boxes = np.zeros((1, 6, 21), np.float32)
    files.write_bytes(root / "graph.onnx", constant_graph((1, 3, 32, 32), {"output0": boxes}, facts))
    classes = np.zeros((1, 2, 8, 8), np.float32)
    told = {"classes": '["road", "car"]', "mean": "[0.5, 0.5, 0.5]", "std": "[1, 1, 1]"}
    files.write_bytes(root / "segmenter.onnx", constant_graph((1, 3, 32, 32), {"output0": classes}, told))


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


def each(*readers: Callable[[Path], object]) -> Callable[[Path], object]:
    """All readers: the first that refuses must not keep the others from the file."""

    def read(root: Path) -> None:
        refused: Exception | None = None
        for reader in readers:
            try:
                reader(root)
            except ValueError as error:
                refused = _least_known(refused, error)
        if refused is not None:
            raise refused

    return read


def _least_known(one: Exception | None, other: Exception) -> Exception:
    """Of two errors the one that is not the project's own, which ends all."""
    if type(other).__name__ not in OWN_ERRORS:
        raise other
    return one or other


OWN_ERRORS = ("FormatError", "RangeError", "ShapeError", "DetectorError", "UsageError", "WriteError")
"""What may be raised of a damaged file."""


def _frames(layout: str, root: Path) -> None:
    dataset = DATASETS[layout](root)
    for name in dataset.identifiers[:3]:
        each(partial(_frame_of, dataset.labels, name), partial(_frame_of, dataset.frame, name))(root)


def _frame_of(read: Callable[[str], object], name: str, _root: Path) -> None:
    read(name)


def _table(layout: str, root: Path) -> None:
    """The labels, and what `convert` makes of them in every layout."""
    table = read_table(root, layout)
    for to in ("kitti", "coco", "yolo"):
        try:
            write_table(table, root.parent / "converted" / to, to, {})
        except ValueError as error:
            _least_known(None, error)


def _meshes_of(names: Sequence[str], root: Path) -> None:
    each(*(partial(_mesh, name) for name in names))(root)


def _mesh(name: str, root: Path) -> None:
    import_mesh(root / name)


def _picture(root: Path) -> None:
    files.read_image(root / "image.png")
    files.read_uint16(root / "depth.png", SIZE_HW)


def _theta(root: Path) -> None:
    base = load_scene(root / "scene")
    frame = root / "frames" / "a"
    budget = budget_of("paper")
    check_change(
        CheckLog(), frame, load_frame(frame / "result.json"), base.at_rest(), base, _PARAMS, budget, "ground"
    )


def _segment(root: Path) -> None:
    OnnxSegmenter(root / "segmenter.onnx")(np.zeros((*SIZE_HW, 3), np.float32))


def _predict(root: Path) -> None:
    predictor = OnnxPredictor(root / "graph.onnx")
    predictor.decode(predictor.forward(torch.zeros(1, 3, *SIZE_HW)))


def _answers(root: Path) -> None:
    name, items = read_key(root / "key.json")
    read_answers(root / "answers.csv", name, items)


def _told_again(root: Path, name: _KeptStudy) -> None:
    for path in root.rglob("*.gz"):
        files.write_bytes(path, gzip.compress(path.with_suffix("").read_bytes()))
    run = classification_run if name == "classification" else study_run
    run(Study(name=name, kept=str(root), bootstrap=0))


def _report(root: Path) -> None:
    report_runs(Report(runs=(str(root),), frames=1, out=str(root.parent / "report.html")))


def _seen(root: Path) -> None:
    detector = load_detector(root / "net.safetensors")
    detector.decode(detector(torch.zeros(1, 3, 32, 64)))


def _darknet(root: Path) -> None:
    detector = darknet.load(root / "net.cfg")
    detector.decode(detector(torch.zeros(1, 3, 32, 64)))


_KeptStudy = Literal["single", "transfer", "retrain", "classification"]
_KEPT: dict[_KeptStudy, Callable[[Path], None]] = {
    "single": _kept,
    "transfer": _kept_transfer,
    "retrain": _kept_retrain,
    "classification": _kept_classification,
}
FORMATS: dict[str, Format] = {
    one.name: one
    for one in (
        Format(
            "kitti labels",
            _kitti,
            each(
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
            each(
                _picture, lambda root: photograph(root / "photo.jpg"), lambda root: photograph(root / "image.png")
            ),
        ),
        Format(
            "virtual kitti 1",
            _vkitti1,
            each(partial(_frames, "vkitti1"), partial(_table, "vkitti1")),
            ("**/*.txt",),
            share=0.25,
        ),
        Format(
            "virtual kitti 2",
            partial(dataset, "vkitti2"),
            each(partial(_frames, "vkitti2"), partial(_table, "vkitti2")),
        ),
        Format(
            "coco json",
            partial(dataset, "coco"),
            each(partial(_frames, "coco"), partial(_table, "coco")),
            ("**/*.json",),
        ),
        Format("yolo", partial(dataset, "yolo"), each(partial(_frames, "yolo"), partial(_table, "yolo"))),
        Format("scene folder", partial(save_scene, scene()), load_scene),
        Format("run", _run, each(load_run, _report), ("*.json", "*.yaml", "**/*.json", "**/*.png"), share=0.1),
        Format("theta.json", _run_with_scene, _theta, ("frames/a/*.json",)),
        Format(
            "settings yaml",
            _settings,
            each(
                lambda root: parse(["attack", "--config", str(root / "preset.yaml")]),
                lambda root: read_frame_edit(root / "edit.yaml"),
                lambda root: read_edits(root / "edits.yaml"),
                lambda root: load_spec(root / "spec.yaml"),
                lambda root: budget_of(str(root / "budget.yaml")),
            ),
            share=0.25,
        ),
        Format("darknet", lambda root: darknet.save(net(), root / "net.cfg"), _darknet),
        Format("obj", _meshes, partial(_meshes_of, ("a.obj",)), ("a.obj", "a.mtl", "image.png")),
        Format("glb", _meshes, partial(_meshes_of, ("a.glb", "own.glb", "a.gltf")), ("*.glb", "*.gltf", "*.bin")),
        Format("ply", _meshes, partial(_meshes_of, ("a.ply", "text.ply")), ("*.ply",)),
        Format("safetensors", _weights, _seen),
        Format("state dict", _states, lambda root: realism_weights.read(root / "state.pth")),
        Format("onnx", _graphs, each(_predict, _segment)),
        Format("survey", _survey, _answers),
        *(
            Format(f"kept {name}", make, partial(_told_again, name=name), ("**/*.json", "**/*.csv"), share=0.25)
            for name, make in _KEPT.items()
        ),
    )
}
