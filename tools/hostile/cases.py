"""Hostile cases: defects once found by hand, and similar ones."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping

from tools.hostile import inputs
from tools.hostile.inputs import (
    COCO,
    DEEP,
    DIGITS,
    FRAME,
    Make,
    both,
    coco,
    detector,
    edited,
    kitti,
    linked,
    png,
    run,
    scene,
    setting,
    text,
    weights,
)
from tools.hostile.trial import HostileCase, Signals

FAMILIES: Mapping[str, str] = {
    "trust": "runs that were edited by hand, or that name code",
    "escapes": "links, devices, and names outside their folder",
    "allocation": "files with huge contents, or that declare them",
    "tracebacks": "values that no reader expects",
    "signals": "Ctrl-C and SIGTERM while two workers run",
    "own detectors": "user detectors that raise, or detect nothing",
}
"""Families of cases, in the order of the table."""

RESULT = f"run/{FRAME}/result.json"
DERENDER = "drivesem derender --dataset kitti --root kitti --workers 1 --out out"
CHECK_MINE = "drivesem check --detector module:mine.py:Mine --size 96x64"
ATTACK = "drivesem attack --dataset kitti --root kitti --no-fit --params translate --workers 1 --out out"


def cases() -> list[HostileCase]:
    """All cases by family."""
    return [*_trust(), *_escapes(), *_allocation(), *_tracebacks(), *_signals(), *_own()]


def _trust() -> Iterator[HostileCase]:
    changed: dict[str, tuple[Make, str]] = {
        "AP set to 0.05": (
            edited("run/metrics.json", "attacked", "moved", "ap50", value=0.05),
            "metrics.json: attacked.moved.ap50",
        ),
        "detector's name": (edited("run/metrics.json", "detector", value="yolov3-slim"), "metrics.json: detector"),
        "data set's name": (edited("run/metrics.json", "dataset", value="demo"), "metrics.json: dataset"),
        "t_star": (edited("run/metrics.json", "t_star", value=0.6), "metrics.json: t_star"),
        "frames that failed": (edited("run/metrics.json", "frames_failed", value={"n1": "why"}), "frames_failed"),
        "loss trace": (edited(RESULT, "loss_trace", value=[9.0]), "loss_trace"),
        "queries": (edited(RESULT, "queries", value=1), "queries"),
        "active constraints": (
            edited(RESULT, "active_constraints", value=["objects[0]: road"]),
            "active_constraints",
        ),
        "identity PSNR": (edited(RESULT, "identity_psnr_db", value=31.0), "identity_psnr_db"),
        "a failure's index": (edited(RESULT, "failures", 0, "index", value=None), "result.json: failures"),
        "a failure that is a phantom": (edited(RESULT, "failures", 0, "kind", value="phantom"), "phantoms"),
        "a failure's grade": (edited(RESULT, "failures", 0, "grade", value="certain"), "failures[0].grade"),
        "a second detector's opinion": (
            edited(
                RESULT, "failures", 0, "peer", value={"by": "yolov3-slim", "before": 8, "after": 8, "draws": 8}
            ),
            "failures",
        ),
        "success": (edited(RESULT, "success_moved", value=False), "success_moved"),
        "score of a detection": (edited(RESULT, "detections_benign", 0, "score", value=0.6), "detections_benign"),
        "steps in config.yaml": (setting("steps", "99"), "config.yaml: steps"),
        "seed in config.yaml": (setting("seed", "7"), "config.yaml: seed"),
        "detector in config.yaml": (setting("detector", "yolov3-slim"), "config.yaml: detector"),
        "overlay": (inputs.overlay, "overlay.png"),
        "counterexample": (inputs.brightened, "counterexample.png"),
        "moved label": (inputs.labels, "labels_moved.txt"),
        "theta.json": (
            edited(f"run/{FRAME}/theta.json", "weather.fog", "value", value=0.1),
            "theta.json: weather.fog",
        ),
        "scene": (
            edited(f"run/{FRAME}/scene/scene.json", "objects", "translation", 0, 0, value=1.0),
            "scene: objects[0].translation",
        ),
        "a file more": (text(f"run/{FRAME}/scene/more.txt", "more"), "scene/more.txt"),
    }
    for name, (make, field) in changed.items():
        yield HostileCase(f"verify: {name}", "trust", both(run, make), "drivesem verify run", (field,), code=1)

    evil = text("evil.py", inputs.EVIL)
    refused = ("run/config.yaml: {}", "--trust")
    for command in (
        "verify run",
        "explain run",
        "confirm run",
        "retrain run",
        "holes run",
        "view run --no-browser",
    ):
        make = both(run, evil, setting("detector", "module:evil.py:D"))
        named = tuple(line.format("detector") for line in refused)
        yield HostileCase(
            f"code in a run: {command.partition(' ')[0]}", "trust", make, f"drivesem {command}", named
        )
    for name, value in {
        "second_detector": "module:evil.py:D",
        "reference_detector": "module:evil.py:D",
        "detector": "planted:height_px=30:38@module:evil.py:D",
    }.items():
        make = both(run, evil, setting(name, value))
        named = tuple(line.format(name) for line in refused)
        yield HostileCase(
            f"code in a run: {value.partition(':')[0]} as {name}", "trust", make, "drivesem verify run", named
        )
    tag = setting("steps", f"!!python/object/apply:os.mkdir [{inputs.MARK}]")
    yield HostileCase("code in YAML", "trust", both(run, tag), "drivesem report run", ("run/config.yaml",))
    make = both(scene, inputs.pickled_arrays)
    yield HostileCase("pickle in a scene", "trust", make, "drivesem render scene", ("arrays.npz", "pickle"))
    make = both(run, inputs.pickled_weights("weights/alexnet-owt-7be5be79.pth"))
    words = "tools.experiments realism run --metrics lpips-alex --weights weights"
    yield HostileCase("pickle in weights", "trust", make, words, ("alexnet-owt-7be5be79.pth",))


def _escapes() -> Iterator[HostileCase]:
    device = "a regular file"
    make = both(kitti(), linked("kitti/training/image_2/n00000.png", "/dev/zero"))
    yield HostileCase("photograph: link to /dev/zero", "escapes", make, DERENDER, ("n00000.png", device))
    make = linked("photo.png", "/dev/zero")
    yield HostileCase(
        "photograph typed: link to /dev/zero",
        "escapes",
        make,
        "drivesem derender photo.png --out out",
        ("photo.png", device),
    )
    for file in ("manifest.json", "metrics.json", "config.yaml", f"{FRAME}/result.json"):
        make = both(run, linked(f"run/{file}", "/dev/zero"))
        yield HostileCase(
            f"{file}: link to /dev/zero", "escapes", make, "drivesem report run", (file.rpartition("/")[2],)
        )
    for name in ("/dev/zero", "../..", "/etc"):
        make = both(run, edited("run/manifest.json", "frames", value={name: {}}))
        yield HostileCase(f"manifest.json: frame {name}", "escapes", make, "drivesem report run", ("frames", name))
    secret = text("secret.json", "{}")
    make = both(run, secret, linked(RESULT, "../../../secret.json"))
    yield HostileCase(
        "link out of a run",
        "escapes",
        make,
        "tools.experiments worth run --distance none",
        ("result.json", "a link to"),
    )
    for name in ("../../secret.png", "/dev/zero"):
        make = coco("images", "file_name", name)
        words = "drivesem derender --dataset coco --root coco --out out"
        yield HostileCase(f"COCO: file_name {name}", "escapes", make, words, ("images[0].file_name", name))
    for name in ("../secret", "/dev"):
        make = both(inputs.layout("yolo"), text("yolo/data.yaml", f"train: {name}\nnames: [Car]\n"))
        words = "drivesem derender --dataset yolo --root yolo --out out"
        yield HostileCase(f"YOLO: train {name}", "escapes", make, words, ("data.yaml: train", name))


def _allocation() -> Iterator[HostileCase]:
    for name, words in {"derender": DERENDER, "attack": ATTACK}.items():
        yield HostileCase(
            f"3,000 cars in a frame: {name}", "allocation", kitti(cars=3000), words, ("n00000", "found 3000")
        )
    yield HostileCase(
        "1,000,000 labels of a frame", "allocation", kitti(cars=10**6), DERENDER, ("n00000.txt", "1,000,000")
    )
    make = both(kitti(), inputs.equal_detections)
    words = "drivesem eval --gt kitti --pred found --protocol kitti"
    yield HostileCase("80,000 equal detections", "allocation", make, words, ("2,000 detections", "80,000"))
    for name, maker in {
        "NPZ header of 10^12 floats": inputs.oversized_arrays,
        "zip bomb of 4 GB": inputs.bomb(),
        "zip bomb that declares 1,000 bytes": inputs.bomb(declared=1000),
    }.items():
        yield HostileCase(name, "allocation", both(scene, maker), "drivesem render scene", ("scene/arrays.npz",))
    lines = [f"{b}: &{b} [*{a}, *{a}, *{a}, *{a}]" for a, b in zip("abcdefghijk", "bcdefghijkl", strict=True)]
    content = "\n".join(["a: &a [x, x, x, x]", *lines, ""])
    yield HostileCase(
        "YAML alias bomb: a run",
        "allocation",
        both(run, text("run/config.yaml", content)),
        "drivesem report run",
        ("config.yaml", "alias"),
    )
    yield HostileCase(
        "YAML alias bomb: a preset",
        "allocation",
        text("bomb.yaml", content),
        "drivesem attack --config bomb.yaml",
        ("bomb.yaml", "alias"),
    )
    words = "drivesem check --detector darknet:net.cfg"
    yield HostileCase("20,000 Darknet layers", "allocation", inputs.layers, words, ("net.cfg", "20001"))
    yield HostileCase("100,000 anchors: Darknet", "allocation", inputs.anchors, words, ("net.cfg", "anchors"))
    words = "drivesem check --detector weights.safetensors"
    many = weights(anchors=str([[10, 10]] * 100_000))
    yield HostileCase("100,000 anchors: weights", "allocation", many, words, ("anchors", "100000"))
    yield HostileCase(
        "2 GB in a header of 1 KB", "allocation", inputs.oversized_weights, words, ("weights.safetensors",)
    )
    make = both(kitti(), inputs.ply("meshes/car.ply", 10**9))
    yield HostileCase("a mesh of 10^9 faces", "allocation", make, f"{DERENDER} --meshes meshes", ("car.ply",))


READERS: Mapping[str, tuple[Make, str, str]] = {
    "config.yaml": (run, "run/config.yaml", "drivesem report run"),
    "manifest.json": (run, "run/manifest.json", "drivesem report run"),
    "metrics.json": (run, "run/metrics.json", "drivesem report run"),
    "result.json": (run, RESULT, "drivesem report run"),
    "theta.json": (run, f"run/{FRAME}/theta.json", "drivesem verify run"),
    "scene.json": (scene, "scene/scene.json", "drivesem render scene"),
    "COCO labels": (inputs.layout("coco"), COCO, "drivesem convert coco --to kitti --out out"),
    "COCO detections": (kitti(), "found.json", "drivesem eval --gt kitti --pred found.json"),
    "YOLO's data.yaml": (
        inputs.layout("yolo"),
        "yolo/data.yaml",
        "drivesem derender --dataset yolo --root yolo --out out",
    ),
    "manifest.json of synth": (
        inputs.layout("kitti"),
        "kitti/manifest.json",
        "drivesem drive kitti --out out",
    ),
    "a preset": (inputs.nothing, "preset.yaml", "drivesem attack --config preset.yaml"),
    "a budget": (inputs.nothing, "budget.yaml", "drivesem attack --budget budget.yaml --out out"),
    "edits": (scene, "edits.yaml", "drivesem edit scene --edits edits.yaml"),
    "a specification": (
        text("mine.py", inputs.MODULE),
        "mine.yaml",
        "drivesem check --detector module:mine.py:Mine,mine.yaml",
    ),
    "a survey's key": (
        text("answers.csv", "survey\n"),
        "key.json",
        "tools.experiments survey-results answers.csv --survey key.json",
    ),
    "a study": (inputs.nothing, "results/study.json", "tools.experiments single --from results --out out"),
    "a run of classify": (inputs.nothing, "run/config.yaml", "drivesem classify confirm run"),
    "glTF": (kitti(), "meshes/car.gltf", f"{DERENDER} --meshes meshes"),
}
"""Every kind of JSON and YAML file that a command reads: maker, file, command."""


def _tracebacks() -> Iterator[HostileCase]:
    for name, (make, file, words) in READERS.items():
        named = (file.rpartition("/")[2],)
        digits = f'{{"a": {DIGITS}}}'
        yield HostileCase(f"deep nesting: {name}", "tracebacks", both(make, text(file, DEEP)), words, named)
        yield HostileCase(f"5,000 digits: {name}", "tracebacks", both(make, text(file, digits)), words, named)
    words = "drivesem check --detector weights.safetensors"
    for name, value in {"deep nesting": DEEP, "5,000 digits": f"[[{DIGITS}, 1]]"}.items():
        yield HostileCase(
            f"{name}: anchors of weights", "tracebacks", weights(anchors=value), words, ("weights.safetensors",)
        )
    yield HostileCase(
        "5,000 digits: KITTI's label", "tracebacks", kitti(lines={2: DIGITS}), DERENDER, ("n00000.txt",)
    )
    for focal in ("1e30", "1e-30", "nan"):
        yield HostileCase(f"f = {focal}", "tracebacks", kitti(focal=focal), DERENDER, ("n00000.txt", "P2"))
    yield HostileCase("f = 1e30: attack", "tracebacks", kitti(focal="1e30"), ATTACK, ("n00000.txt", "P2"))
    photo = "drivesem derender photo.png --out out"
    huge = png("photo.png", 100_000, 100_000)
    yield HostileCase("PNG header of 100000x100000", "tracebacks", huge, photo, ("photo.png", "px"))
    make = both(kitti(), png("kitti/training/image_2/n00000.png", 100_000, 100_000))
    yield HostileCase("PNG header of 100000x100000: KITTI", "tracebacks", make, DERENDER, ("n00000.png", "px"))
    yield HostileCase("photograph of 1x1", "tracebacks", inputs.one_pixel("photo.png"), photo, ("1x1 px",))
    make = both(kitti(), inputs.one_pixel("kitti/training/image_2/n00000.png"))
    yield HostileCase("photograph of 1x1: KITTI", "tracebacks", make, DERENDER, ("1x1 px",))
    for value in (10**9, -(10**9), 1e300):
        make = both(scene, edited("scene/scene.json", "sources", 0, "foreground", "x0", value=value))
        yield HostileCase(
            f"crop x0 = {value:g}", "tracebacks", make, "drivesem render scene", ("scene.json", "foreground")
        )
    for table, key, value, named in (
        ("images", "id", [1], "images[0].id"),
        ("categories", "id", [1], "categories[0].id"),
        ("annotations", "image_id", [1], "annotations[0].image_id"),
        ("annotations", "category_id", {"a": 1}, "annotations[0].category_id"),
        ("images", "file_name", "a\0.png", "NUL"),
        ("images", "file_name", "\ud800.png", "half of one"),
        ("categories", "name", "\udfff", "half of one"),
    ):
        name = f"COCO: {table}.{key} = {value!a}"
        yield HostileCase(
            name, "tracebacks", coco(table, key, value), "drivesem convert coco --to kitti --out out", (named,)
        )
    words = "drivesem check --detector darknet:net.cfg"
    yield HostileCase(".names that is not UTF-8", "tracebacks", inputs.names, words, ("net.names",))
    for name, command in {
        "report": "drivesem report run",
        "worth": "tools.experiments worth run --distance none",
    }.items():
        for what, make, named in (
            (
                "box of three numbers",
                edited(RESULT, "targets_benign", 0, "xyxy", value=[1, 2, 3]),
                "targets_benign[0]: xyxy",
            ),
            (
                "text score",
                edited(RESULT, "detections_benign", 0, "score", value="high"),
                "detections_benign[0]: score",
            ),
            ("t_star a text", edited("run/metrics.json", "t_star", value="half"), "metrics.json: t_star"),
            ("detector: 5", setting("detector", "5"), "config.yaml: detector"),
        ):
            yield HostileCase(f"{what}: {name}", "tracebacks", both(run, make), command, (named,))
    make = both(run, setting("detector", "5"))
    yield HostileCase("detector: 5: verify", "tracebacks", make, "drivesem verify run", ("config.yaml: detector",))
    for command in ("check --detector weights.safetensors", "attack --detector weights.safetensors --out out"):
        name = f"t_star NaN in weights: {command.partition(' ')[0]}"
        yield HostileCase(
            name, "tracebacks", weights(t_star="nan"), f"drivesem {command}", ("weights.safetensors", "t_star")
        )
    for command in ("convert kitti --to coco --out out", DERENDER.removeprefix("drivesem ")):
        for what, lines, named in (
            ("height -1.5", {8: "-1.5"}, "height"),
            ("truncation -5", {1: "-5"}, "truncat"),
            ("truncation 1.5", {1: "1.5"}, "truncat"),
        ):
            name = f"{what}: {command.partition(' ')[0]}"
            yield HostileCase(name, "tracebacks", kitti(lines=lines), f"drivesem {command}", ("n00000", named))


def _signals() -> Iterator[HostileCase]:
    attack = "drivesem attack --combo 2 --no-fit --steps 2 --no-grade --workers 2 --out out"
    created, first = "out/config.yaml", "out/frames/demo-*"
    moments = [
        ("", 2.0),
        ("", 3.0),
        (created, 0.0),
        (created, 1.0),
        (created, 3.0),
        (created, 5.0),
        (first, 0.0),
        (first, 2.0),
    ]
    for ready, after in moments:
        begin = {"": "the start", created: "it made its folder", first: "its first frame"}[ready]
        when = f"{after:g} s after {begin}"
        for name, sent, number, code in (
            ("Ctrl-C", (after,), signal.SIGINT, 130),
            ("Ctrl-C twice", (after, after + 0.2), signal.SIGINT, 130),
            ("SIGTERM", (after,), signal.SIGTERM, 143),
        ):
            yield HostileCase(
                f"{name}, {when}",
                "signals",
                inputs.nothing,
                attack,
                ("interrupted",),
                code,
                Signals(ready, sent, number),
                unlimited=True,
            )
    make = both(kitti(), text("script.py", inputs.SCRIPT))
    yield HostileCase("two workers, no main guard", "signals", make, "python script.py", code=0, unlimited=True)


def _own() -> Iterator[HostileCase]:
    for name, method in {
        "__init__": "def __init__(self):",
        "forward": "def forward(self, images):",
        "decode": "def decode(self, raw):",
        "loss": "def loss(self, raw, targets):",
    }.items():
        make = detector(method, 'raise KeyError("wheels")')
        yield HostileCase(
            f"raises in {name}: check", "own detectors", make, CHECK_MINE, ("KeyError", f"mine.py:7, in {name}")
        )
    make = detector(module_code="import nowhere")
    yield HostileCase("raises when imported: check", "own detectors", make, CHECK_MINE, ("nowhere",))
    make = detector(module_code="def broken(:")
    yield HostileCase("no Python: check", "own detectors", make, CHECK_MINE, ("SyntaxError", "(mine.py:2)"))
    mine, evaluation = "--detector module:mine.py:Mine", "drivesem eval --dataset kitti --root kitti --workers 1"
    words = f"{ATTACK} {mine}"
    for name, method, command in (
        ("forward: attack", "def forward(self, images):", words),
        ("decode: attack", "def decode(self, raw):", words),
        ("loss: attack", "def loss(self, raw, targets):", words),
        ("decode: eval", "def decode(self, raw):", f"{evaluation} {mine}"),
        ("decode: drive", "def decode(self, raw):", f"drivesem drive {mine} --limit 4 --out out"),
    ):
        make = both(kitti(), detector(method, 'raise KeyError("wheels")'))
        named = ("--detector", "KeyError", f"mine.py:7, in {name.partition(':')[0]}")
        unlimited = "drive" in name  # de-rendering comes before the first detection
        yield HostileCase(f"raises in {name}", "own detectors", make, command, named, unlimited=unlimited)
    make = both(kitti(), detector("def decode(self, raw):", 'raise KeyError("wheels")'))
    two = words.replace("--workers 1", "--workers 2")
    named = ("--detector", "mine.py:7, in decode")
    yield HostileCase("raises in decode: attack, two workers", "own detectors", make, two, named, unlimited=True)
    make = both(kitti(), text("mine.py", inputs.BLIND))
    yield HostileCase("finds no car: attack", "own detectors", make, words, ("--detector", "finds something"))
