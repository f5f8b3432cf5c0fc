"""`drivesem classify`: pictures of objects, classifiers trained on them, and attacks on these."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from drivesem.classify.attack import attack_run
from drivesem.classify.pictures import write_pictures
from drivesem.classify.results import ClassifiedRun
from drivesem.classify.training import train_run
from drivesem.report.answer import print_json
from drivesem.report.classified import share
from drivesem.report.tables import Sheet, percent
from drivesem.report.terminal import Console
from drivesem.run.folder import claim, folder_of
from drivesem.run.page import PAGE
from drivesem.settings.commands import Classify
from drivesem.settings.devices import check_device


def run(config: Classify) -> int:
    """Draw, train or attack; exit code 0. Raises UsageError or SceneError for bad input."""
    check_device(config.device)
    does = {"data": _data, "train": _train, "attack": _attack}
    does[config.what](config, Console(stderr=True) if config.json else Console())
    return 0


def _data(config: Classify, console: Console) -> None:
    out = folder_of(config.out, Path("runs") / "classify-pictures")
    claim(out, config, ("train", "val", "test"))
    counts, failed = write_pictures(config, out)
    _say_failed(failed, console)
    told = ", ".join(f"{count} {split}" for split, count in counts.items())
    console.print(f"pictures in {out}: {told}", soft_wrap=True, markup=False)
    if config.json:
        print_json({"out": str(out), "pictures": counts, "frames_failed": failed})


def _train(config: Classify, console: Console) -> None:
    data = train_run(config)
    rows = tuple((str(e["epoch"]), f"{e['loss']:.4f}", percent(e["val"])) for e in data["epochs"])
    sheet = Sheet(f"{config.network}: {config.layers} layers", ("epoch", "loss", "accuracy on val, %"), rows)
    console.print(sheet.table(()))
    accuracy = ", ".join(f"{name} {percent(value)} %" for name, value in data["accuracy"].items())
    _say_failed(data["frames_failed"], console)
    console.print(f"accuracy: {accuracy}; weights: {data['weights']}", soft_wrap=True, markup=False)
    if config.json:
        print_json(data)


def _attack(config: Classify, console: Console) -> None:
    found = attack_run(config)
    console.print(_table(found).table(("class",)))
    grades = found.grades
    console.print(
        f"{found.pictures} pictures, {found.queries} queries, {found.passes} passes in {found.seconds:.0f} s: "
        f"{grades['threshold']} misclassified by threshold, {grades['certain']} for certain",
        soft_wrap=True,
    )
    _say_failed(found.frames_failed, console)
    console.print(f"report: {Path(found.out) / PAGE}", soft_wrap=True, markup=False)
    if config.json:
        print_json(found.to_json())


def _table(run: ClassifiedRun) -> Sheet:
    rows = [
        (one.name, str(one.pictures), *_shares(one.benign, one.attacked, one.pictures), str(one.certain))
        for one in run.classes
        if one.pictures
    ]
    rows.append(("all", str(run.pictures), percent(run.benign), percent(run.attacked), str(run.grades["certain"])))
    title = f"{run.network} on {run.objects} objects: {run.method}, {' + '.join(run.params)}"
    return Sheet(title, ("class", "pictures", "accuracy, %", "attacked, %", "certain"), tuple(rows))


def _shares(benign: int, attacked: int, pictures: int) -> tuple[str, str]:
    return percent(share(benign, pictures)), percent(share(attacked, pictures))


def _say_failed(failed: Mapping[str, str], console: Console) -> None:
    for name, reason in failed.items():
        console.print(f"{name} could not be used: {reason}", soft_wrap=True, markup=False)
