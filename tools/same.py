"""Run a fixed suite of commands and hash all that they write and print, to test that a restructuring changes nothing.

python tools/same.py --out before.txt            # with the old code
python tools/same.py --out after.txt             # with the new code
python tools/same.py --compare before.txt after.txt

A line of a table is `case/file hash`; hashes ignore times, versions and paths. Both tables must come from one
machine. `--only 'convert|eval'` takes the cases with matching names, after those that they need. `--work DIR` keeps
the files of the commands in DIR. Commands run with the Python and the `drivesem` of this script.

With `--renamed FILE`, `--compare` takes two such folders and compares values of JSON, YAML and CSV files after it
has renamed keys, columns, parts of file names and words; it ignores prose (.md, .html, .err, .out unless JSON, and
the cases help and refused). A line of FILE is `OLD NEW`.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image
from rich.console import Console
from rich.progress import Progress

import drivesem
from drivesem.reporting.tables import format_count

VARYING = {"seconds", "seconds_now", "versions", "images_a_second", "processor_seconds_an_image", "stamp"}
"""Keys of JSON and columns of CSV that differ from run to run."""
TIMES = re.compile(r"\b\d+(\.\d+)?(e-?\d+)? ?(s|ms|min|minutes|seconds|images a second|processor seconds each)\b")
CLOCK = re.compile(r"\b\d+:\d\d(:\d\d)?\b|-:--:--")
BLANKS = re.compile(r"[ \t]+|[─━┅╌═]+")
TEXTS = {".txt", ".csv", ".md", ".html", ".yaml", ".json", ".out", ".err", ".log"}
LEFT_OUT = {".lock"}
MINUTES = 20
"""Time limit of a command."""
PROSE = {".md", ".html", ".err"}
"""Suffixes of files that --renamed ignores."""
ROOT = Path(drivesem.__file__).parents[1]

ALL = "--params color,weather,foliage,translate,rotate,mesh"
ATTACK = f"attack {ALL} --workers 1 --limit 1 --out @/run"
WORKERS = "--workers 1"
RUN, SET, FOUND = "@attack-si-fgsm/run", "@synth-kitti/set", "@eval-detector/figures/detections"
SCENE = "@derender-demo/scenes/demo-000"
SMALL, TINY = "--dataset kitti --root @small", "--dataset kitti --root @tiny --no-fit"

SUITE = f"""
attack-si-fgsm: attack {ALL} {WORKERS} --limit 2 --steps 3 --out @/run
attack-apgd: {ATTACK} --method apgd --steps 3 --objective failure --target-classes Car
attack-fgsm: {ATTACK} --method fgsm --steps 3
attack-sgd: {ATTACK} --method sgd --steps 2 --momentum 0.5 --objective-labels paper --json
attack-scw: {ATTACK} --method scw --queries 4 --steps 2
attack-random: {ATTACK} --method random --queries 3
attack-halton: {ATTACK} --method halton --queries 3 --range steps
attack-cma-es: {ATTACK} --method cma-es --queries 4
attack-placebo: {ATTACK} --method placebo --like {RUN}
attack-two: attack --params weather,rotate {WORKERS} --limit 2 --steps 3 --out @/run
attack-kitti: attack {SMALL} --no-fit {WORKERS} --limit 1 --combo 2 --steps 2 --detector yolov3-slim\
 --budget parking --out @/run
study-multi: tools.experiments multi --quick {TINY} --limit 1 --steps 1 --bootstrap 5 {WORKERS} --out @/study
study-samples: tools.experiments samples --quick {TINY} --limit 1 --steps 1 --queries 2 --bootstrap 5 {WORKERS}\
 --out @/study
study-transfer: tools.experiments transfer --quick {TINY} --limit 1 --steps 1 --bootstrap 5 {WORKERS} --out @/study
study-retrain: tools.experiments retrain --quick --limit 2 --fresh 1 --benign-frames 2 --steps 3 --train-steps 2\
 --bootstrap 5 {WORKERS} --out @/study
derender-demo: derender --limit 1 --sheet {WORKERS} --out @/scenes
derender-kitti: derender {SMALL} {WORKERS} --limit 1 --sheet --out @/scenes
derender-photo: derender @small/training/image_2/000001.png --focal 360 --fast {WORKERS} --out @/scenes
render: render {SCENE} -o @/render.png
edit: edit {SCENE} --set objects[0].translate=0.5m,0m --set objects[1].color=0.3,0,0,0,0 --set weather=fog\
 --remove 2 -o @/edit.png --save @/scene
edit-file: edit {SCENE} --edits @inputs/scene-edits.yaml -o @/edit.png
synth-kitti: synth --frames 4 --seed 3 --validation 0.25 --variations clone {WORKERS} --out @/set
synth-vkitti2: synth --layout vkitti2 --frames 1 --sequence 1 --cameras 2 --variations clone,fog --out @/set\
 {WORKERS}
synth-vkitti1: synth --layout vkitti1 --frames 2 --sequence 2 --split heldout {WORKERS} --out @/set
synth-coco: synth --layout coco --frames 2 --seed 3 --sheet --compare {WORKERS} --out @/set
synth-yolo: synth --layout yolo --frames 2 --seed 4 --people False {WORKERS} --json --out @/set
synth-edits: synth --frames 1 --seed 3 --variations clone --edits @inputs/street-edits.yaml {WORKERS} --out @/set
eval-detector: eval --detector squeezedet --root {SET} --pictures 1 --out @/figures
eval-yolov3: eval --detector yolov3-slim --root {SET} --bootstrap 20 --out @/figures
eval-coco: eval --gt {SET} --pred {FOUND} --out @/figures
eval-kitti: eval --gt {SET} --pred {FOUND} --protocol kitti --pred-b @eval-yolov3/figures/detections\
 --bootstrap 20 --out @/figures
eval-voc: eval --gt {SET} --pred {FOUND} --protocol voc --json
eval-run: eval --gt {RUN} --pred {RUN} --pred-b {RUN} --stage-b benign --out @/figures
convert-coco: convert {SET} --to coco --out @/set --copy-images
convert-yolo: convert {SET} --to yolo --out @/set --copy-images
convert-vkitti1: convert {SET} --to vkitti1 --out @/set --copy-images --map Pedestrian=-,Cyclist=-
convert-vkitti2: convert {SET} --to vkitti2 --out @/set --copy-images --map Pedestrian=-,Cyclist=-
convert-from-coco: convert @synth-coco/set --to kitti --out @/set
convert-from-yolo: convert @synth-yolo/set --to kitti --out @/set --json
convert-from-vkitti1: convert @synth-vkitti1/set --to kitti --out @/set
convert-from-vkitti2: convert @synth-vkitti2/set --to kitti --out @/set
convert-scores: convert {FOUND} --to coco --out @/results.json --scores --image-size 1242x375
explain: explain --run @attack-two/run --points 2 --permutations 2 --bootstrap 5 {WORKERS} --out @/explain
confirm: confirm --run {RUN} {WORKERS} --out @/confirm
transfer: transfer --run {RUN} --detectors squeezedet,yolov3-slim --bootstrap 5 {WORKERS} --out @/transfer
verify: verify --run {RUN} {WORKERS} --out @/verify.json
plausibility: tools.experiments plausibility --run {RUN} --out @/plausibility
realism: tools.experiments realism {RUN} --bootstrap 5 --out @/realism
worth: tools.experiments worth {RUN} --second yolov3-slim --out @/worth
worth-table: tools.experiments worth --table @inputs/answers.csv --base 2 --out @/worth
survey: tools.experiments survey {RUN} --items 2 --controls 1 --out @/survey
survey-results: tools.experiments survey-results @answers/ann.csv @answers/bob.csv --survey @survey/survey\
 --bootstrap 5 --out @/results
report: report {RUN} --out @/report.html
report-runs: report {RUN} @attack-placebo/run --frames 1 --out @/report.html --json
report-study: report @study-samples/study --out @/report.html
check: check --detector squeezedet --size 96x64 --json
check-yolov3: check --detector yolov3-slim --size 96x64
anchors: train --root {SET} --anchors 3
presets: attack --config list --json
gradcheck: tools.bench gradcheck {TINY} --directions 1 {WORKERS} --out @/gradcheck
train: train --root @small --held-out @small --steps 3 --batch 2 --window 96x64 --checkpoint-every 2\
 --evaluate-every 2 --semantic 0.25 {WORKERS} --out @/run
train-yolov3: train --detector yolov3-slim --root @small --steps 2 --batch 2 --window 96x64 --optimiser sgd\
 {WORKERS} --out @/run
retrain: retrain --run {RUN} --steps 2 --batch 2 --window 96x64 --validation 0.5 --fraction 0.5 --ramp 0.5\
 --attack-steps 1 {WORKERS} --out @/retrain
"""
"""Name and command of each case. `@` is the case's folder, `@name` that of another case, which runs first."""

REFUSED = f"""
:  | frobnicate
attack: --combo 7 | --combo 2 --params mesh | --params wheels | --steps 0 | --steps many | --limit 0
  | --workers 0 | --dataset kitti | --dataset kitty --root . | --root somewhere | --objective-labels mine
  | --frobnicate | --config nowhere.yaml | --config @inputs/key.yaml | --config @inputs/list.yaml
  | --config @inputs/broken.yaml | --config @inputs/flag.yaml | --config @inputs/mapping.yaml
  | --detector nowhere.safetensors | --detector retinanot | --detector onnx:none.onnx | --device quantum
  | --budget huge | --queries 3 | --method fgsm --range steps | --method fgsm --early-stop
  | --method random --queries 0
  | --method random --precision bfloat16 | --precision float16
  | --method placebo | --method placebo --like nowhere
  | --momentum 2 | --rate 0 | --t-star 1.5 | --target-classes Tree --limit 1 | --limit 2 --seed 5 --out {RUN}
  | --limit 1 --out @inputs/texts
tools.experiments:  | fifty | single --steps 0 | samples --queries 0 | single --bootstrap -1 | single --dataset kitti
  | single --t-star 2 | single --budget huge | transfer --detectors squeezdet | transfer --detectors ,
  | transfer --sources squeezedet,squeezedet | retrain --held-out x | retrain --fresh 0
  | retrain --detector squeezdet | multi --confirm --dataset kitti --root @inputs/D
derender: --velodyne | --device cuda | --meshes . | photo.png | photo.png --meshes nowhere | --focal 3
  | @inputs/photo.png --focal -3 | @inputs/photo.png --dataset kitti --root .
  | @inputs/photo.png --meshes @inputs/empty | @inputs/photo.png --meshes @inputs/bad
  | @inputs/photo.png --segmenter @inputs/wrong.onnx | --segmenter none.onnx | --dataset kitti --root nowhere
  | --dataset coco --root nowhere | --dataset vkitti2 --root nowhere | --dataset vkitti1 --root nowhere
  | --dataset yolo --root nowhere | --dataset kitti --root @inputs/D --velodyne
  | --limit 1 --seed 1 --out @derender-demo/scenes | --out {SCENE}
render:  | nowhere | @derender-demo/scenes | @inputs/scene
edit:  | {SCENE} | {SCENE} --set objects[99].rotate=1deg | {SCENE} --set objects[0].rotate=1
  | {SCENE} --set objects[0].wheels=1 | {SCENE} --set weather=snow | {SCENE} --remove 99 | {SCENE} --remove red
  | {SCENE} --edits nowhere.yaml | {SCENE} --remove 0 -o a.jpg | {SCENE} --remove 0 --save @inputs/texts
synth: --frames 0 | --sequence 0 | --validation 1.5 | --cameras 2 | --layout vkitti2 --people True
  | --variations night | --edits nothing.yaml | --edits @inputs/key.yaml | --meshes nowhere | --assets nowhere
  | --layout voc | --out @inputs/photo.png | --frames 4 --seed 4 --out {SET}
bench: step --cars 0 | step --cars 99 | render --triangles 1 | step --threads 0
  | step --detector nowhere.safetensors | step --device quantum | step --out @inputs/photo.png
tools.bench: synth --frames 3 | derender --frames 0 | gradcheck --directions 0 | gradcheck --min-cosine 2
  | gradcheck --max-error 0 | found --detector onnx:gone.onnx | found --dataset kitti --root . --scenes .
  | found --scenes @inputs/empty | label-free --dataset kitti --root nowhere
eval:  | --gt a --pred b --detector squeezedet | --gt a --pred b | --gt a --pred b --bootstrap -1
  | --detector squeezedet | --detector squeezedet --root . --pictures 2
  | --detector squeezedet --root . --device fpga | --detector retinanot --root . | --gt {SET} --pred @inputs/flat
  | --gt {SET} --pred @inputs/empty | --gt {SET} --pred {FOUND} --map Car=Tractor
  | --gt {SET} --pred {FOUND} --classes Tractor | --gt @inputs/dog.json --pred @inputs/broken.json
convert: {SET} --to coco --out x --image-size big | {SET} --to yolo --out x.json | {SET} --to yolo --out {SET}
  | {SET} --to coco --out x --map Car | {SET} --to coco --out x --map Bus=Car | nothing --to coco --out x
  | @inputs/flat --to coco --out x | @inputs/flat --to vkitti2 --out x | @inputs/dog.json --to kitti --out x
explain:  | --run none | --run {RUN} --points 0 | --run {RUN} --permutations 3 | --run {RUN} --bootstrap -1
  | --run {RUN} --frame demo-077
confirm:  | --run @inputs/empty | --run {RUN} --root @inputs/empty
transfer: --detectors squeezedet | --run none --detectors squeezedet | --run {RUN}
  | --run {RUN} --detectors squeezdet | --run {RUN} --detectors squeezedet,squeezedet
  | --run {RUN},{RUN} --detectors squeezedet
verify:  | --run @inputs/empty | --run @inputs/run | --run {RUN} --out @inputs/empty
tools.experiments plausibility: --run @inputs/empty | --run {RUN} --limit 0 | --run {RUN} --out @inputs/photo.png
tools.experiments realism:  | @inputs/empty | {RUN} {RUN} | {RUN} --metrics psnr,beauty | {RUN} --metrics lpips-alex
  | {RUN} --weights nowhere
tools.experiments worth:  | {RUN} --table x.csv | --table @inputs/nan.csv | --table @inputs/texts/readme.txt
  | {RUN} --after x.csv | {RUN} --second nowhere.safetensors | {RUN} --base 1
tools.experiments survey:  | {RUN} --items 0
tools.experiments survey-results:  | @inputs/answers.csv | @inputs/answers.csv --survey @survey/survey
  | @inputs/answers.csv --survey @inputs/dog.json
report:  | nowhere | @inputs/empty | {RUN} {RUN} | {RUN} --frames 0 | {RUN} --out @inputs/empty
check: --detector yolo9 | --detector squeezedet --size 32x32
train:  | --root {SET} --anchors 0 | --dataset demo --anchors 3
  | --root {SET} --detector retinanot | --root {SET} --window 640 | --root {SET} --scale 2,1
  | --root {SET} --precision float16 | --root {SET} --drops never | --root {SET} --start nowhere.safetensors
  | --root {SET} --start squeezenet | --root {SET} --detector yolov3-slim --loss quality | --root @inputs/empty
  | --dataset synth --root .
retrain: --run nowhere | --run @inputs/run | --run @inputs/other | --run @inputs/run --fraction 1
  | --run @inputs/run --validation 0 | --run @inputs/run --root x
"""
"""Invalid command lines: options of each command, separated by `|`. They share one process."""

SHARED = """
import contextlib, io, json, runpy, sys, traceback
with open(sys.argv[1]) as commands, open(sys.argv[2], "w") as outputs:
    for module, *words in map(json.loads, commands):
        out, err, code = io.StringIO(), io.StringIO(), 0
        sys.argv = [module, *words]
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                runpy.run_module(module, run_name="__main__", alter_sys=True)
            except SystemExit as stop:
                code = stop.code
            except BaseException:
                code = traceback.format_exc()
        print(json.dumps([code, out.getvalue(), err.getvalue()]), file=outputs, flush=True)
"""
"""A program that runs the command lines of one file and writes their outputs to another."""


def make_inputs(folder: Path, _: Path) -> None:
    """Write small input files: edits, tables, and unreadable files."""
    image = Image.fromarray(np.full((60, 200, 3), 90, np.uint8))
    for name in ("photo.png", "D/training/image_2/000000.png"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        image.save(folder / name)
    dog = {
        "images": [{"id": 1, "width": 9, "height": 9}],
        "annotations": [{"image_id": 1, "category_id": 1, "bbox": [1, 1, 2, 2]}],
        "categories": [{"id": 1, "name": "dog"}],
    }
    texts = {
        "D/training/label_2/000000.txt": "",
        "D/training/calib/000000.txt": "P2: 90 0 100 0 0 90 30 0 0 0 1 0\n",
        "answers.csv": "label,bench,bus,distance\nbench,0.9,0.1,0\nbench,0.3,0.7,0.2\nbus,0.2,0.8,0.4\n",
        "nan.csv": "label,bench,bus\nbus,0.5,nan\n",
        "scene-edits.yaml": "objects:\n  0: {translate: [0.5m, 0.25m], rotate: 10deg}\n  1: {remove: true}\n",
        "street-edits.yaml": "frames:\n  all:\n    weather: {fog: 0.3}\n    objects: {all: {rotate: 10deg}}\n",
        "key.yaml": "combos: 2\n",
        "list.yaml": "[1, 2]\n",
        "broken.yaml": "combo: [\n",
        "flag.yaml": "json: 3\n",
        "mapping.yaml": "steps: {a: 1}\n",
        "broken.json": "{",
        "dog.json": json.dumps(dog),
        "flat/000000.txt": "Car 0 0 -10 1 2 30 40 -1 -1 -1 -1000 -1000 -1000 -10\n",
        "texts/readme.txt": "no mesh",
        "bad/car.obj": "v 1 2\nf 1 2 3\n",
        "wrong.onnx": "no network",
        "run/config.yaml": "dataset: demo\n",
        "other/config.yaml": "photo: a.png\n",
        "scene/scene.json": '{"version": 99}',
    }
    for name, text in texts.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    (folder / "empty").mkdir()


def sort_labels(path: Path) -> list[list[str]]:
    """Words of each line of a KITTI label file; cars of at least 30 px come first, the narrowest before others."""

    def order(words: list[str]) -> tuple[bool, float]:
        left, top, right, bottom = map(float, words[4:8])
        return words[0] != "Car" or bottom - top < 30, right - left

    return sorted((line.split() for line in path.read_text().splitlines()), key=order)


def copy_crop(
    source: Path, target: Path, name: str, scale: float, window: tuple[int, ...], objects: slice
) -> None:
    """Copy a resized and cropped frame of a KITTI folder; the principal point becomes the middle of the crop.

    Args:
        source: KITTI folder to read.
        target: KITTI folder to write.
        name: Identifier of the frame.
        scale: Factor of the image size.
        window: Crop x0, y0, x1, y1 of the resized image, px.
        objects: Which of its objects to copy, in the order of `sort_labels`.
    """
    for kind in ("image_2", "label_2", "calib"):
        (target / kind).mkdir(parents=True, exist_ok=True)
    camera = next(row for row in (source / f"calib/{name}.txt").read_text().splitlines() if row.startswith("P2:"))
    focal, _, u, _, _, _, v, *_ = (scale * float(word) for word in camera.split()[1:])
    x0, y0, x1, y1 = window
    middle_u, middle_v = (x1 - x0) / 2, (y1 - y0) / 2
    (target / f"calib/{name}.txt").write_text(f"P2: {focal} 0 {middle_u} 0 0 {focal} {middle_v} 0 0 0 1 0\n")
    with (target / f"label_2/{name}.txt").open("w") as file:
        for words in sort_labels(source / f"label_2/{name}.txt")[objects]:
            numbers = [float(word) for word in words[1:]]
            numbers[3:7] = [scale * value - shift for value, shift in zip(numbers[3:7], (x0, y0) * 2, strict=True)]
            x, y, z = numbers[10:13]
            numbers[10:12] = x + z * (u - x0 - middle_u) / focal, y + z * (v - y0 - middle_v) / focal
            print(words[0], *(f"{value:.2f}" for value in numbers), file=file)
    with Image.open(source / f"image_2/{name}.png") as image:
        resized = image.resize((round(image.width * scale), round(image.height * scale)))
        resized.crop(window).save(target / f"image_2/{name}.png")


def make_small(folder: Path, work: Path) -> None:
    """Two generated frames at half size."""
    for name in ("000001", "000002"):
        copy_crop(work / "synth-kitti/set/training", folder / "training", name, 0.5, (0, 0, 621, 187), slice(None))


def make_tiny(folder: Path, work: Path) -> None:
    """One car of a generated frame."""
    source = work / "synth-kitti/set/training"
    left, top, right, bottom = (float(word) for word in sort_labels(source / "label_2/000000.txt")[0][4:8])
    x0, y0 = round((left + right) / 2) - 48, round((top + bottom) / 2) - 32
    copy_crop(source, folder / "training", "000000", 1.0, (x0, y0, x0 + 96, y0 + 64), slice(1))


def make_answers(folder: Path, work: Path) -> None:
    """Write the answers of two people to the survey."""
    key = json.loads((work / "survey/survey/survey-key.json").read_text())
    for person, shift in (("ann", 0), ("bob", 2)):
        with (folder / f"{person}.csv").open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(("survey", "participant", "item", "position", "named", "realism", "seconds"))
            for place, item in enumerate(key["items"], start=1):
                rows.writerow((key["survey"], person, item["item"], place, "Car", 2 * place + shift, 3.5))


MADE: dict[str, tuple[Callable[[Path, Path], None], tuple[str, ...]]] = {
    "inputs": (make_inputs, ()),
    "small": (make_small, ("synth-kitti",)),
    "tiny": (make_tiny, ("synth-kitti",)),
    "answers": (make_answers, ("survey",)),
}
"""Folders that this script makes, and the cases that it needs for them; they are not part of the table."""


def suite() -> dict[str, list[str]]:
    """Command lines by case: one for each line of SUITE, many for `help` and `refused`."""
    cases = {name: [line] for name, _, line in (row.partition(": ") for row in SUITE.strip().splitlines())}
    parts = [row.partition(":") for row in REFUSED.replace("\n ", "").strip().splitlines()]
    help_lines = ["--help", *(f"{command} --help" for command, *_ in parts if command)]
    refused = [f"{command} {options.strip()}".strip() for command, _, row in parts for options in row.split("|")]
    return cases | {"help": help_lines, "refused": refused}


def required_cases(name: str, cases: dict[str, list[str]]) -> set[str]:
    """Cases that wrote the files a case reads."""
    return set(MADE[name][1]) if name in MADE else set(re.findall(r"@([a-z0-9-]+)", " ".join(cases[name])))


def sort_cases(names: Iterable[str], cases: dict[str, list[str]]) -> list[str]:
    """The cases and all that they require, each after those that it requires."""
    order: dict[str, None] = {}

    def add(name: str) -> None:
        for required in sorted(required_cases(name, cases)):
            add(required)
        order.setdefault(name)

    for name in names:
        add(name)
    return list(order)


class Hasher:
    """Hashes files without what varies from run to run."""

    def __init__(self, places: Mapping[Path, str], renamed: Mapping[str, str] | None = None) -> None:
        """Create a hasher.

        Args:
            places: Folders, and the word to write for each.
            renamed: New by old word; if given, the order of keys and columns does not count.
        """
        self._places = {str(place): name for place, name in places.items()}
        self._renamed = renamed or {}
        words = "|".join(map(re.escape, sorted(self._renamed, key=len, reverse=True)))
        self._pattern = re.compile(rf"(?<![A-Za-z0-9])({words})(?![A-Za-z0-9])") if words else None

    def rename(self, text: str) -> str:
        """The text with renamed words."""
        return text if self._pattern is None else self._pattern.sub(lambda match: self._renamed[match[1]], text)

    def text(self, text: str) -> str:
        """The text without places, times and the clock, with renamed words."""
        for place, name in sorted(self._places.items(), key=lambda item: -len(item[0])):
            text = text.replace(place, name)
        return self.rename(CLOCK.sub("CLOCK", TIMES.sub("TIME", text)))

    def plain(self, value: Any) -> Any:
        """A JSON value without the keys of VARYING."""
        if isinstance(value, dict):
            return {self.text(str(key)): self.plain(item) for key, item in value.items() if key not in VARYING}
        if isinstance(value, list):
            return [self.plain(item) for item in value]
        return self.text(value) if isinstance(value, str) else value

    def content(self, path: Path) -> Iterator[bytes]:
        """The hashed bytes of a file."""
        data = path.read_bytes()
        if path.suffix == ".npz":
            with np.load(io.BytesIO(data)) as arrays:
                for name, array in arrays.items():
                    yield f"{name} {array.dtype} {array.shape}".encode()
                    yield array.tobytes()
        elif path.suffix == ".safetensors":
            start = 8 + int.from_bytes(data[:8], "little")
            yield self._dump(json.loads(data[8:start])).encode()
            yield data[start:]
        elif path.suffix in TEXTS:
            yield self.normalise(path.suffix, data.decode(errors="replace")).encode()
        else:
            yield data

    def _dump(self, value: Any) -> str:
        return json.dumps(self.plain(value), sort_keys=bool(self._renamed))

    def normalise(self, suffix: str, text: str) -> str:
        """The hashed part of a text."""
        if suffix == ".json" or (suffix == ".out" and text.startswith("{")):
            try:
                return self._dump(json.loads(text))
            except json.JSONDecodeError:
                return self.text(text)
        if suffix == ".yaml" and self._renamed:
            return self._dump(yaml.safe_load(text))
        if suffix == ".csv":
            rows = list(csv.reader(io.StringIO(text)))
            heading = [self.rename(name) for name in rows[0]] if rows else []
            chosen = [i for i, name in enumerate(heading) if name not in VARYING]
            chosen = sorted(chosen, key=heading.__getitem__) if self._renamed else chosen
            return self.text("\n".join(",".join(row[i] for i in chosen if i < len(row)) for row in rows))
        text = self.text(text)
        return BLANKS.sub(" ", text) if suffix in (".out", ".err") else text

    def hash(self, path: Path) -> str:
        """SHA-256 of the hashed bytes of a file."""
        digest = hashlib.sha256()
        for part in self.content(path):
            digest.update(part)
        return digest.hexdigest()

    def rows(self, case: str, folder: Path) -> dict[str, str]:
        """Hashes of all files of a case by name."""
        return {f"{case}/{path.relative_to(folder).as_posix()}": self.hash(path) for path in list_files(folder)}


def list_files(folder: Path) -> list[Path]:
    """All files below a folder that count."""
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.name not in LEFT_OUT)


def hash_values(work: Path, renamed: Mapping[str, str], only: str) -> dict[str, str]:
    """Hashes of all files but prose by renamed name.

    Args:
        work: Folder of --work.
        renamed: New by old word.
        only: Regular expression of cases.
    """
    hasher = Hasher({work.resolve(): "WORK"}, renamed)
    cases = [
        case for case in sorted(work.iterdir()) if case.is_dir() and case.name not in {"help", "refused", *MADE}
    ]
    return {
        hasher.rename(path.relative_to(work).as_posix()): hasher.hash(path)
        for case in cases
        if re.search(only, case.name)
        for path in list_files(case)
        if path.suffix not in PROSE and (path.suffix != ".out" or path.read_bytes().startswith(b"{"))
    }


def environment(work: Path) -> dict[str, str]:
    """Environment of commands: one thread and width, no colours, GPU, foreign weights or warnings."""
    settings = {"OMP_NUM_THREADS": "1", "COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1", "PYTHONHASHSEED": "0"}
    settings |= {"CUDA_VISIBLE_DEVICES": "", "PYTHONWARNINGS": "ignore", "TORCH_HOME": str(work / "torch")}
    settings |= {"PYTHONPATH": str(ROOT)}
    return os.environ | settings


def command_words(line: str, case: Path, place: Path) -> list[str]:
    """Module and words of a command.

    Args:
        line: Command line, of `drivesem` unless it starts with a module of tools.
        case: Folder of the case.
        place: Folder in which the command runs.
    """
    filled = re.sub(
        r"@([a-z0-9-]*)", lambda match: os.path.relpath(case.parent / match[1] if match[1] else case, place), line
    )
    words = shlex.split(filled)
    return words if words and words[0].startswith("tools.") else ["drivesem.cli", *words]


def run_alone(line: str, folder: Path) -> str:
    """Run a command in its case's folder and write its output there. Returns the exit code."""
    words = [sys.executable, "-m", *command_words(line, folder, folder)]
    finished = subprocess.run(
        words, cwd=folder, env=environment(folder.parent), capture_output=True, text=True, timeout=60 * MINUTES
    )
    (folder / "said.out").write_text(finished.stdout)
    (folder / "said.err").write_text(finished.stderr)
    return str(finished.returncode)


def run_shared(lines: Sequence[str], folder: Path) -> str:
    """Run commands in one process, in an empty folder, and write their outputs. Returns their exit codes."""
    place, commands, outputs = folder / "empty", folder / "commands.jsonl", folder / "outputs.jsonl"
    place.mkdir()
    commands.write_text("".join(f"{json.dumps(command_words(line, folder, place))}\n" for line in lines))
    words = [sys.executable, "-c", SHARED, str(commands), str(outputs)]
    finished = subprocess.run(
        words, cwd=place, env=environment(folder.parent), capture_output=True, text=True, timeout=60 * MINUTES
    )
    results = [json.loads(text) for text in outputs.read_text().splitlines()]
    for line, (code, out, err) in zip(lines, results, strict=False):
        name = re.sub(r"[^\w.,=-]+", "_", line) or "nothing"
        (folder / f"{name}.txt").write_text(f"exit {code}\n{out}\n{err}")
    commands.unlink()
    outputs.unlink()
    return finished.stderr if finished.returncode else " ".join(sorted({str(code)[-80:] for code, *_ in results}))


def run_case(name: str, lines: Sequence[str], work: Path) -> str:
    """Run a case in its own folder. Returns exit codes or an error."""
    folder = work / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        if name in MADE:
            MADE[name][0](folder, work)
            return "made"
        return run_alone(lines[0], folder) if name not in ("help", "refused") else run_shared(lines, folder)
    except (OSError, LookupError, ValueError, subprocess.TimeoutExpired) as error:
        return f"{type(error).__name__}: {error}"


def run_suite(only: str, work: Path, jobs: int, console: Console) -> dict[str, str]:
    """Run the matching cases after those that they require.

    Args:
        only: Regular expression of cases.
        work: Folder for the cases' folders.
        jobs: Cases that run at a time.
        console: Where to show progress.

    Returns:
        Hashes by file of the matching cases.
    """
    cases = suite()
    chosen = [name for name in cases if re.search(only, name)]
    order = sort_cases(chosen, cases)
    console.print(f"{len(order)} cases of {ROOT} in {work}")
    hasher = Hasher({work: "WORK", ROOT: "REPO", Path(sys.prefix): "PYTHON"})
    pending: dict[str, Future[None]] = {}
    table: dict[str, str] = {}

    def run(name: str) -> None:
        for required in required_cases(name, cases):
            pending[required].result()
        start = time.perf_counter()
        ended = run_case(name, cases.get(name, ()), work)
        if name in chosen:
            table.update(hasher.rows(name, work / name) | {f"{name}/exit": hasher.text(" ".join(ended.split()))})
        progress.console.print(f"{name}: {ended} ({time.perf_counter() - start:.1f} s)", markup=False)
        progress.advance(task)

    with Progress(console=console) as progress, ThreadPoolExecutor(jobs) as pool:
        task = progress.add_task("cases", total=len(order))
        # required cases are submitted first, so no thread waits for a case that has not started
        for name in order:
            pending[name] = pool.submit(run, name)
        for future in pending.values():
            future.result()
    return table


def read_table(path: Path, only: str) -> dict[str, str]:
    """Hashes by file of the cases with matching names."""
    rows = dict(line.rsplit(" ", 1) for line in path.read_text().splitlines())
    return {name: value for name, value in rows.items() if re.search(only, name.partition("/")[0])}


def differences(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """A line for each file that is gone, new or different."""
    names = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
    return [f"{'new' if n not in before else 'gone' if n not in after else 'differs'}: {n}" for n in names]


def main(argv: Sequence[str] | None = None) -> int:
    """Make a table or compare two. Returns 1 if they differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="table to write")
    parser.add_argument(
        "--compare", type=Path, nargs=2, metavar=("BEFORE", "AFTER"), help="tables, or folders with --renamed"
    )
    parser.add_argument("--renamed", type=Path, help="file of lines OLD NEW: compare values of two folders")
    parser.add_argument("--only", default="", metavar="PATTERN", help="regular expression of cases to run")
    parser.add_argument("--work", type=Path, help="folder to work in and keep; by default a temporary one")
    parser.add_argument("--jobs", type=int, default=1, help="parallel cases")
    arguments = parser.parse_args(argv)
    if (arguments.out is None) == (arguments.compare is None):
        parser.error("one of --out and --compare")
    if arguments.compare:
        read = partial(read_table, only=arguments.only)
        if arguments.renamed is not None:
            renamed = dict(line.split() for line in arguments.renamed.read_text().splitlines() if line.strip())
            read = partial(hash_values, renamed=renamed, only=arguments.only)
        lines = differences(*map(read, arguments.compare))
        print("\n".join([*lines, format_count(len(lines), "line differs", "lines differ")]))
        return 1 if lines else 0
    with tempfile.TemporaryDirectory() as temporary:
        work = (arguments.work or Path(temporary)).resolve()
        work.mkdir(parents=True, exist_ok=True)
        table = run_suite(arguments.only, work, arguments.jobs, Console(stderr=True))
    arguments.out.write_text("".join(f"{name} {value}\n" for name, value in sorted(table.items())))
    return 0


if __name__ == "__main__":
    sys.exit(main())
