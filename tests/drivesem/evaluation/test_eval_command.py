"""`drivesem eval` as a user types it: files of every layout, figures, and one line for what cannot be."""

import contextlib
import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from drivesem.cli import main
from drivesem.reporting.drawing import LOST_COLOUR
from scene_ir import files

Run = Callable[..., tuple[int, dict, str]]
BOXES = [(100.0, 100.0, 200.0, 160.0), (300.0, 100.0, 380.0, 170.0), (500.0, 120.0, 590.0, 180.0)]
POSE = "1.5 1.7 4.2 2.0 1.6 20.0 0.1"


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*words: object) -> tuple[int, dict, str]:
        code = main(["eval", *map(str, words), "--json"])
        streams = capsys.readouterr()
        return code, json.loads(streams.out) if streams.out else {}, streams.err

    return call


def _line(
    kind: str, box: Sequence[float], score: float | None = None, truncated: float = 0, occluded: int = 0
) -> str:
    unknown = "-1 -1 -1 -1000 -1000 -1000 -10"
    pose = unknown if kind == "DontCare" else POSE
    text = f"{kind} {truncated:g} {occluded} -10 {' '.join(f'{v:.2f}' for v in box)} {pose}"
    return text if score is None else f"{text} {score:.4f}"


def _write(folder: Path, frames: Sequence[Sequence[str]]) -> Path:
    folder.mkdir(parents=True)
    for i, lines in enumerate(frames):
        (folder / f"{i:06d}.txt").write_text("".join(f"{line}\n" for line in lines))
    return folder


@pytest.fixture
def kitti(tmp_path: Path) -> tuple[Path, Path]:
    """Two frames: three cars of which two are found, a van, a false positive."""
    gt = _write(
        tmp_path / "gt",
        [[_line("Car", BOXES[0]), _line("Car", BOXES[1], truncated=0.2), _line("Van", BOXES[2])],
         [_line("Car", BOXES[0], occluded=1), _line("DontCare", (600, 0, 900, 300), truncated=-1, occluded=-1)]],
    )  # fmt: skip
    pred = _write(
        tmp_path / "pred",
        [[_line("Car", BOXES[0], 0.9), _line("Car", BOXES[2], 0.8), _line("Car", (0, 0, 60, 60), 0.7)],
         [_line("Car", BOXES[0], 0.6), _line("Car", (650, 100, 750, 200), 0.5)]],
    )  # fmt: skip
    return gt, pred


def test_kitti_rows(run: Run, kitti: tuple[Path, Path]):
    code, data, text = run("--gt", kitti[0], "--pred", kitti[1], "--protocol", "kitti", "--bootstrap", 0)
    assert code == 0
    assert "small detections: ignore" in text
    assert len(data["rows"]) == 9
    rows = {(row["class"], row["difficulty"]): row for row in data["rows"]}
    assert set(rows["Car", "easy"]) >= {"class", "difficulty", "r11", "r40", "ground_truth"}
    assert rows["Car", "easy"]["ground_truth"] == 1
    assert rows["Car", "moderate"]["ground_truth"] == 3
    # thresholds 0.9 and 0.6; the van's detection counts nowhere, the DontCare's neither
    assert rows["Car", "moderate"]["r11"] == pytest.approx(1 / 11)
    assert rows["Car", "moderate"]["r40"] == pytest.approx((2 / 3) / 40)
    assert rows["Cyclist", "hard"]["r40"] is None
    assert data["small_detections"] == "ignore"


def test_whole_kitti_folders_and_the_older_kit(run: Run, kitti: tuple[Path, Path], tmp_path: Path):
    (tmp_path / "kitti/training").mkdir(parents=True)
    kitti[0].rename(tmp_path / "kitti/training/label_2")
    (tmp_path / "results").mkdir()
    kitti[1].rename(tmp_path / "results/data")
    low = _line("Car", (0, 300, 60, 330), 0.95)
    with (tmp_path / "results/data/000000.txt").open("a") as file:
        file.write(f"{low}\n")
    words = ("--gt", tmp_path / "kitti", "--pred", tmp_path / "results", "--protocol", "kitti", "--bootstrap", 0)
    new = run(*words)[1]["rows"][0]
    old = run(*words, "--small-detections", "count")[1]["rows"][0]
    assert (new["r11"], old["r11"]) == (pytest.approx(1 / 11), pytest.approx(0.5 / 11))


def _coco(folder: Path, seed: int = 0) -> tuple[Path, Path, list[dict]]:
    draw = np.random.default_rng(seed)
    annotations, results = [], []
    for image in (5, 9, 20):
        for _ in range(6):
            box = [round(v, 2) for v in (*draw.uniform(0, 300, 2), *draw.uniform(10, 150, 2))]
            category = int(draw.choice([3, 8]))
            annotations.append(
                {"id": len(annotations) + 1, "image_id": image, "category_id": category, "bbox": box,
                 "area": box[2] * box[3] * 0.7, "iscrowd": int(draw.random() < 0.1)}
            )  # fmt: skip
            moved = [round(v * draw.normal(1, 0.05), 2) for v in box]
            results.append(
                {"image_id": image, "category_id": category, "bbox": moved, "score": round(draw.random(), 2)}
            )
    draw.shuffle(results)  # pyright: ignore[reportArgumentType]
    content = {
        "images": [{"id": i, "file_name": f"a/{i}.png", "width": 640, "height": 480} for i in (20, 5, 9)],
        "categories": [{"id": 8, "name": "truck"}, {"id": 3, "name": "car"}],
        "annotations": annotations,
    }
    (folder / "gt.json").write_text(json.dumps(content))
    (folder / "pred.json").write_text(json.dumps(results))
    return folder / "gt.json", folder / "pred.json", results


def _pycocotools(gt: Path, results: list[dict]) -> list[float]:
    with contextlib.redirect_stdout(io.StringIO()):
        truth = COCO(str(gt))
        evaluator = COCOeval(truth, truth.loadRes([dict(row) for row in results]), "bbox")
        evaluator.evaluate()
        evaluator.accumulate()
        evaluator.summarize()
    return evaluator.stats.tolist()


@pytest.mark.parametrize("seed", range(3))
def test_coco_stats_are_those_of_pycocotools(run: Run, tmp_path: Path, seed: int):
    gt, pred, results = _coco(tmp_path, seed)
    code, data, _ = run("--gt", gt, "--pred", pred, "--bootstrap", 0)
    assert code == 0
    assert data["stats"] == pytest.approx(_pycocotools(gt, results), abs=1e-9)
    assert data["metrics"]["AP"] == pytest.approx(data["stats"][0], abs=1e-12)


def _repeat_ids(content: dict) -> None:
    for row in content["annotations"]:
        row["id"] = 1 + row["id"] % 4


def _split_category(content: dict) -> None:
    """Half of the trucks belong to a second category of their name; a third one is an unused parent."""
    content["categories"] += [{"id": 9, "name": "truck"}, {"id": 0, "name": "car", "supercategory": "none"}]
    for row in [row for row in content["annotations"] if row["category_id"] == 8][::2]:
        row["category_id"] = 9


def _break_outlines(content: dict) -> None:
    for i, row in enumerate(content["annotations"]):
        row["segmentation"] = [[[1, 2, 3, 4]], [], [[1, 2, 3]], None, "x"][i % 5]


def _move_out(content: dict) -> None:
    for row in content["annotations"][::3]:
        row["bbox"][0] -= 400


@pytest.mark.parametrize("change", [_repeat_ids, _split_category, _break_outlines, _move_out])
def test_the_two_tables_agree_on_unusual_files(run: Run, tmp_path: Path, change: Callable[[dict], None]):
    gt, pred, results = _coco(tmp_path)
    content = json.loads(gt.read_text())
    if change is _move_out:
        change(content)
        gt.write_text(json.dumps(content))
    expected = _pycocotools(gt, results)  # of the file without the fault
    if change is not _move_out:
        change(content)
        gt.write_text(json.dumps(content))
    code, data, _ = run("--gt", gt, "--pred", pred, "--bootstrap", 0)
    assert code == 0
    assert data["stats"] == pytest.approx(expected, abs=1e-9)
    assert data["metrics"]["AP"] == pytest.approx(data["stats"][0], abs=1e-12)
    assert [row["class"] for row in data["classes"]] == ["car", "truck"]


def test_one_set_in_three_layouts_gives_the_same_metrics(run: Run, kitti: tuple[Path, Path], tmp_path: Path):
    for source, more in ((kitti[0], []), (kitti[1], ["--scores"])):
        words = [str(source), "--to", "coco", "--out", str(tmp_path / f"{source.name}.json"), *more]
        assert main(["convert", *words, "--image-size", "1242x375"]) == 0
    words = ("--protocol", "coco", "--bootstrap", 0)
    plain = run("--gt", kitti[0], "--pred", kitti[1], *words)[1]
    requested = run("--gt", tmp_path / "gt.json", "--pred", tmp_path / "pred.json", *words)[1]
    mixed = run("--gt", kitti[0], "--pred", tmp_path / "pred.json", *words)[1]
    assert requested["stats"] == pytest.approx(plain["stats"], abs=1e-9)
    assert mixed["stats"] == pytest.approx(plain["stats"], abs=1e-9)
    for name in ("Car", "Van"):
        rows = [next(r for r in d["classes"] if r["class"] == name) for d in (plain, requested, mixed)]
        assert rows[0]["ap50"] == rows[1]["ap50"] == rows[2]["ap50"]


@pytest.mark.parametrize("protocol", ["coco", "kitti", "voc"])
def test_a_box_without_an_area_meets_nothing(run: Run, tmp_path: Path, protocol: str):
    flat = (300.0, 100.0, 300.0, 170.0)
    gt = _write(tmp_path / "gt", [[_line("Car", BOXES[0]), _line("Car", flat)]])
    pred = _write(tmp_path / "pred", [[_line("Car", BOXES[0], 0.9), _line("Car", flat, 0.8)]])
    code, data, _ = run("--gt", gt, "--pred", pred, "--protocol", protocol, "--bootstrap", 0)
    assert code == 0
    car = next(row for row in data["classes"] if row["class"] == "Car")
    assert (car["objects"], car["recall"]) == (2, 0.5)


def test_voc(run: Run, kitti: tuple[Path, Path]):
    row = run("--gt", kitti[0], "--pred", kitti[1], "--protocol", "voc")[1]["classes"][0]
    # hits at ranks 1 and 4 of 4 false or true (one lies on DontCare), three cars
    assert row["class"] == "Car"
    assert row["ap"] == pytest.approx((1 + 2 / 4) / 3)
    assert row["ap07"] == pytest.approx((4 * 1 + 3 * 0.5) / 11)
    assert row["recall"] == pytest.approx(2 / 3)


def test_classes_are_mapped_and_left_out(run: Run, kitti: tuple[Path, Path]):
    words = ("--gt", kitti[0], "--pred", kitti[1], "--bootstrap", 0)
    as_cars = run(*words, "--map-gt", "Van=Car")[1]
    assert [row["objects"] for row in as_cars["classes"]] == [4]
    assert [row["class"] for row in run(*words, "--map-gt", "Van=-")[1]["classes"]] == ["Car"]
    assert [row["class"] for row in run(*words, "--classes", "Van")[1]["classes"]] == ["Van"]


def test_some_frames(run: Run, kitti: tuple[Path, Path], tmp_path: Path):
    (tmp_path / "val.txt").write_text("000001\n")
    data = run("--gt", kitti[0], "--pred", kitti[1], "--frames", tmp_path / "val.txt")[1]
    assert (data["frames"], data["objects"], data["detections"]) == (1, 1, 2)


def test_requested_frames_must_exist(run: Run, kitti: tuple[Path, Path], tmp_path: Path):
    (kitti[1] / "000000.txt").unlink()
    (tmp_path / "val.txt").write_text("000001\n")
    assert run("--gt", kitti[0], "--pred", kitti[1], "--frames", tmp_path / "val.txt")[0] == 0
    (tmp_path / "val.txt").write_text("000000\n000001\n")
    code, _, text = run("--gt", kitti[0], "--pred", kitti[1], "--frames", tmp_path / "val.txt")
    assert code == 2
    assert "none of 000000" in text


def test_files(run: Run, kitti: tuple[Path, Path], tmp_path: Path):
    out = tmp_path / "out"
    words = ("--gt", kitti[0], "--pred", kitti[1], "--pred-b", kitti[1], "--protocol", "kitti")
    data = run(*words, "--bootstrap", 20, "--out", out)[1]
    names = {path.name for path in out.iterdir()}
    assert names >= {"metrics.json", "report.md", "kitti-2d.csv", "classes.csv", "parts.csv", "curves.csv"}
    assert names >= {"precision-recall.png", "kitti-car.png", "recall-by-distance.png", "recall-by-occlusion.png"}
    assert json.loads((out / "metrics.json").read_text()) == data
    assert "| Car | moderate |" in (out / "report.md").read_text()
    assert (out / "kitti-2d.csv").read_text().splitlines()[0] == "class,difficulty,R40,R11,objects"
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert run(*words, "--bootstrap", 20, "--out", out)[1] == data
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    # a detector beside itself: no difference, no evidence
    car = next(one for one in data["comparison"] if one["name"] == "Car moderate R40")
    assert (car["difference"], car["low"], car["high"], car["p"]) == (0.0, 0.0, 0.0, 1.0)
    assert data["intervals"][0]["name"] == "Car easy R40"


def test_parts(run: Run, kitti: tuple[Path, Path]):
    parts = {(p["class"], p["by"], p["part"]): p for p in run("--gt", kitti[0], "--pred", kitti[1])[1]["parts"]}
    near = parts["Car", "distance", "20-30 m"]
    assert (near["objects"], near["recall"]) == (3, pytest.approx(2 / 3))
    assert (parts["Car", "occlusion", "partly"]["objects"], parts["Car", "occlusion", "partly"]["recall"]) == (
        1,
        1.0,
    )
    assert parts["Car", "size", "40-80 px high"]["objects"] == 3


def _broken(folder: Path, name: str) -> list[object]:
    """The words of a call that cannot work."""
    gt = _write(folder / "gt", [[_line("Car", BOXES[0])], [_line("Car", BOXES[1])]])
    pred = folder / "pred"
    words: list[object] = ["--gt", gt, "--pred", pred, "--protocol", "kitti"]
    good = [[_line("Car", BOXES[0], 0.9)], [_line("Car", BOXES[1], 0.8)]]
    if name == "ids":
        _write(pred, good)
        (pred / "000001.txt").rename(pred / "000007.txt")
    elif name == "missing frame":
        _write(pred, good[:1])
    elif name == "empty files":
        _write(pred, [[], []])
    elif name == "empty folder":
        pred.mkdir()
    elif name == "nothing there":
        pass
    elif name == "class":
        _write(pred, [[_line("Tractor", BOXES[0], 0.9)], good[1]])
    elif name == "NaN":
        _write(pred, [[good[0][0].replace("0.9000", "nan")], good[1]])
    elif name == "no score":
        _write(pred, [[_line("Car", BOXES[0])], good[1]])
    elif name == "no number":
        _write(pred, [[good[0][0].replace("0.9000", "high")], good[1]])
    elif name == "turned box":
        _write(pred, [[_line("Car", (200, 100, 100, 160), 0.9)], good[1]])
    elif name.startswith("coco"):
        truth, detected, results = _coco(folder)
        words = ["--gt", truth, "--pred", detected]
        if name == "coco ids":
            detected.write_text(json.dumps([results[0], results[1] | {"image_id": 77}]))
        elif name == "coco class":
            detected.write_text(json.dumps([results[0] | {"category_id": 99}]))
        elif name == "coco NaN":
            detected.write_text(json.dumps([results[0] | {"score": float("nan")}]))
        elif name == "coco no score":
            detected.write_text(json.dumps([{k: v for k, v in results[0].items() if k != "score"}]))
        elif name == "coco none":
            detected.write_text("[]")
        elif name == "coco texts":
            detected.write_text(json.dumps([row | {"image_id": str(row["image_id"])} for row in results]))
        elif name == "coco empty":
            detected.write_text("")
        elif name == "coco no json":
            detected.write_text("{")
        elif name == "coco box":
            detected.write_text(json.dumps([results[0] | {"bbox": [1, 2, 3]}]))
    return words


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("ids", r"expected ids of the 2 labelled frames, found 000007"),
        ("missing frame", r"expected detections of every labelled frame \(or --frames\), found none of 000001"),
        ("empty files", r"expected at least one detection, found 2 empty files"),
        ("empty folder", r"no label file"),
        ("nothing there", r"pred: expected a file or folder of labels, found nothing there"),
        (
            "class",
            r"class 'Tractor': expected one of Car, .* or --map Tractor=CLASS \(or Tractor=-\), found 1 box of it",
        ),
        ("NaN", r"000000\.txt:1: score: expected a finite number, found nan"),
        ("no score", r"000000\.txt:1: expected 16 fields \(with a score\), found 15"),
        ("no number", r"000000\.txt:1: score: expected a number, found 'high'"),
        ("turned box", r"000000\.txt:1: right: expected at least 200, found 100"),
        ("coco ids", r"image_id: expected ids of the 3 images, found 1 others \(77\)"),
        ("coco class", r"pred\.json\[0\]\.category_id: expected ids of the 2 categories, found 1 others \(99\)"),
        ("coco NaN", r"\[0\]\.score: expected a finite number, found NaN"),
        ("coco no score", r"\[0\]\.score: expected a finite number, found null"),
        ("coco empty", r"pred\.json: expected COCO annotations or results, found an empty file"),
        ("coco none", r"pred\.json: expected at least one detection, found an empty list"),
        (
            "coco texts",
            r"pred\.json\[0\]\.image_id: expected whole numbers, as the ids of the images are, found \"",
        ),
        ("coco no json", r"pred\.json:1:2: expected JSON"),
        ("coco box", r"\[0\]\.bbox: expected x, y, width, height"),
    ],
)
def test_one_line_and_exit_code_2(run: Run, tmp_path: Path, name: str, message: str):
    import re

    code, data, text = run(*_broken(tmp_path, name))
    assert (code, data) == (2, {})
    assert len(text.splitlines()) == 1
    assert re.search(message, text), text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "--gt and --pred, or --detector: expected one or the other, found neither"),
        (("--gt", "a", "--pred", "b", "--detector", "squeezedet"), "one or the other, found both"),
        (
            ("--detector", "squeezedet", "--root", ".", "--pictures", "2"),
            "--pictures: expected --detector and --out",
        ),
        (("--detector", "squeezedet", "--root", ".", "--pictures", "-1"), "--pictures: expected at least 0"),
        (("--detector", "squeezedet", "--root", ".", "--device", "fpga"), "--device: expected a torch device"),
        (("--detector", "squeezedet"), "--root: expected the folder of data set 'kitti', found nothing"),
        (("--gt", "a", "--pred", "b", "--bootstrap", "-1"), "--bootstrap: expected at least 0, found -1"),
        (("--detector", "retinanot", "--root", "."), "image_2"),
    ],
)
def test_bad_settings(run: Run, words: tuple[str, ...], message: str):
    code, _, text = run(*words)
    assert code == 2
    assert message in text


def test_virtual_kitti_and_its_weather(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    from drivesem.data.registry import open_dataset

    root = tmp_path / "virtual"
    words = ["--layout", "vkitti2", "--frames", "1", "--sequence", "1", "--variations", "clone,fog"]
    assert main(["synth", *words, "--out", str(root), "--workers", "1"]) == 0
    capsys.readouterr()
    dataset = open_dataset("vkitti2", root)
    (tmp_path / "pred").mkdir()
    for name in dataset.identifiers:
        labels = dataset.labels(name)
        assert labels is not None
        rows = zip(labels.kind, labels.boxes_xyxy.tolist(), strict=True)
        lines = [_line(kind, box, 0.9 - 0.01 * i) for i, (kind, box) in enumerate(rows)]
        retained = lines if "clone" in name else lines[:1]
        (tmp_path / "pred" / f"{name.replace('/', '_')}.txt").write_text("\n".join(retained) + "\n")
    data = run("--gt", root, "--pred", tmp_path / "pred", "--bootstrap", 0)[1]
    recall = {(p["class"], p["part"]): p["recall"] for p in data["parts"] if p["by"] == "weather"}
    assert {part for _, part in recall} == {"clone", "fog"}
    assert all(value == 1 for (_, part), value in recall.items() if part == "clone")
    assert sum(value < 1 for (_, part), value in recall.items() if part == "fog")


def test_yolo_text_files(run: Run, tmp_path: Path, kitti: tuple[Path, Path]):
    from PIL import Image

    images = tmp_path / "images"
    images.mkdir()
    for name in ("000000", "000001"):
        Image.new("RGB", (1242, 375)).save(images / f"{name}.png")
    for source, more in ((kitti[0], ["--copy-images", "--map", "Van=-"]), (kitti[1], ["--scores"])):
        words = [str(source), "--to", "yolo", "--out", str(tmp_path / f"yolo-{source.name}"), *more]
        assert main(["convert", *words, "--images", str(images)]) == 0
    plain = run("--gt", kitti[0], "--pred", kitti[1], "--map-gt", "Van=-", "--bootstrap", 0)[1]
    data = run("--gt", tmp_path / "yolo-gt", "--pred", tmp_path / "yolo-pred/labels/train", "--bootstrap", 0)[1]
    assert data["classes"][0]["class"] == "Car"
    assert data["classes"][0]["recall"] == plain["classes"][0]["recall"]
    # the region is lost in YOLO's layout: one false positive more
    assert data["detections"] == plain["detections"] == 5


def test_a_run_of_the_attack(run: Run, tmp_path: Path):
    from drivesem.run.results import BoxRecord, FrameResult, dump_frame

    truth = (BoxRecord(BOXES[0], "Car"), BoxRecord(BOXES[1], "Car"), BoxRecord(BOXES[2], "Car", ignore=True))
    found = tuple(BoxRecord(box, "Car", score=0.9) for box in BOXES)
    result = FrameResult(
        identifier="demo-000", objects=3, queries=1, loss_trace=(), theta=(), active_constraints=(), violations=(),
        targets_benign=truth, targets_moved=truth, detections_benign=found, detections_rerendered=found,
        detections_attacked=found[:1], failures=(), became_ignored=(), judged=(0, 1), found_before=(0, 1),
        success_paper=True, success_moved=True, identity_psnr_db=None, seconds=0.0,
    )  # fmt: skip
    (tmp_path / "run/frames/demo-000").mkdir(parents=True)
    (tmp_path / "run/frames/demo-000/result.json").write_text(dump_frame(result))
    words = ("--gt", tmp_path / "run", "--pred", tmp_path / "run", "--protocol", "voc")
    assert run(*words)[1]["classes"][0]["recall"] == 0.5
    assert run(*words, "--stage", "benign")[1]["classes"][0]["recall"] == 1.0
    both = run(*words, "--stage", "benign", "--pred-b", tmp_path / "run", "--stage-b", "attacked-paper")[1]
    assert both["comparison"][0]["difference"] == pytest.approx(-0.5)


@pytest.fixture
def kitti_with_images(tmp_path: Path) -> Path:
    """KITTI's layout: a grey frame without objects, and one with three cars, cut off by 0, 40 and 70 %."""
    cars = [_line("Car", box, truncated=share) for box, share in zip(BOXES, (0, 0.4, 0.7), strict=True)]
    _write(tmp_path / "kitti/training/label_2", [[], cars])
    calibration = "P2: 721.5 0 609.6 44.9 0 721.5 172.9 0.2 0 0 1 0.003\nR0_rect: 1 0 0 0 1 0 0 0 1\n"
    for name in ("000000", "000001"):
        files.write_png(tmp_path / f"kitti/training/image_2/{name}.png", np.full((375, 1242, 3), 120, np.uint8))
        files.write_text(tmp_path / f"kitti/training/calib/{name}.txt", calibration)
    return tmp_path / "kitti"


def test_a_detectors_frames_are_shared_and_one_that_cannot_be_used_is_listed(
    run: Run, tmp_path: Path, kitti_with_images: Path
):
    words = ("--detector", "squeezedet", "--root", kitti_with_images, "--bootstrap", 0)
    alone, shared = run(*words, "--workers", 1)[1], run(*words, "--workers", 2)[1]
    assert alone == shared
    assert alone["frames"] == 2
    (kitti_with_images / "training/image_2/000000.png").write_bytes(b"no picture")
    words = (*words, "--workers", 1)
    assert run(*words)[0] == 2
    code, data, text = run(*words, "--keep-going")
    assert (code, data["frames"], list(data["failed"])) == (0, 1, ["000000"])
    assert "frame 000000 could not be used: " in text
    (kitti_with_images / "training/image_2/000001.png").write_bytes(b"no picture")
    code, _, text = run(*words, "--keep-going")
    assert code == 2
    assert "--root: expected frames that can be used, found none" in text
    code, _, text = run("--gt", "a", "--pred", "b", "--engine", "ray")
    assert code == 2
    assert "--engine: expected --detector, found none" in text


def test_a_detectors_mistakes_are_drawn_worst_first(run: Run, tmp_path: Path, kitti_with_images: Path):
    words = ("--detector", "squeezedet", "--root", kitti_with_images, "--bootstrap", 0, "--workers", 1)
    code, data, _ = run(*words, "--out", tmp_path / "out", "--pictures", 1)
    assert code == 0
    assert data["intervals"] == []
    # frame 000001 has objects that no detector finds in plain grey, 000000 none
    assert [p.name for p in (tmp_path / "out/pictures").iterdir()] == ["001-000001.png"]
    picture = files.read_image(tmp_path / "out/pictures/001-000001.png")
    assert picture.shape[:2] == (375 + 22, 1242)
    assert picture[150, 100].tolist() == list(LOST_COLOUR)  # the left edge of what was missed


def test_truncation_decides_what_is_judged(run: Run, kitti_with_images: Path):
    words = ("--detector", "squeezedet", "--root", kitti_with_images, "--bootstrap", 0, "--workers", 1)
    assert [run(*words, "--max-truncation", share)[1]["objects"] for share in (0.3, 0.5, 1.0)] == [1, 2, 3]


def test_a_detector_on_a_data_set(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    root = tmp_path / "kitti"
    assert main(["synth", "--frames", "2", "--out", str(root), "--workers", "1"]) == 0
    capsys.readouterr()
    code, data, _ = run(
        "--detector", "squeezedet", "--root", root, "--out", tmp_path / "out", "--limit", 2, "--workers", 1
    )
    assert code == 0
    assert (data["frames"], data["headline"], data["min_height"], data["max_occlusion"]) == (2, "Car", 25.0, 1)
    assert data["ap50"] == data["per_class"]["Car"]["ap50"]
    assert sorted(p.name for p in (tmp_path / "out/detections").iterdir()) == ["000000.txt", "000001.txt"]
    more = run(
        "--detector", "squeezedet", "--root", root, "--min-height", 0, "--max-occlusion", 3, "--workers", 1
    )[1]
    assert more["objects"] >= data["objects"]
    names = [one["name"] for one in data["intervals"]]
    assert names == ["AP50", "recall"]
    for one, value in zip(data["intervals"], (data["ap50"], data["recall"]), strict=True):
        assert one["value"] == pytest.approx(value)
        assert 0 <= one["low"] <= value <= one["high"] <= 1
    code, again, _ = run(
        "--gt", root, "--pred", tmp_path / "out/detections", "--protocol", "kitti", "--bootstrap", 0
    )
    assert code == 0
    assert again["detections"] > 0
