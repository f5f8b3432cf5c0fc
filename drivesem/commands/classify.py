"""`drivesem classify`: pictures of objects, classifiers trained on them, and attacks on these."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drivesem.classify.attack import attack_run
from drivesem.classify.confirm import confirm_run
from drivesem.classify.gate import gate_run
from drivesem.classify.holes import holes_run
from drivesem.classify.least import explain_run
from drivesem.classify.page import shares
from drivesem.classify.pictures import write_pictures
from drivesem.classify.results import ClassifiedRun, ClassTally
from drivesem.classify.training import train_run
from drivesem.config.commands import Classify
from drivesem.config.devices import check_device
from drivesem.report.answer import print_json
from drivesem.report.tables import Sheet, number_of, percent
from drivesem.report.terminal import Console
from drivesem.run.ask import say, say_end
from drivesem.run.folder import claim, folder_of
from drivesem.run.page import PAGE

_ASKED = {"explain": explain_run, "holes": holes_run, "gate": gate_run}


def run(config: Classify) -> int:
    """Draw, train, attack, or ask about a run; exit code 0, and 1 where a gate is not passed.
    Raises UsageError or SceneError for bad input."""
    check_device(config.device)
    if config.what in _ASKED:
        answer = _ASKED[config.what](config)
        say(answer, config.json)
        return 0 if answer.data.get("passed", True) else 1
    does = {"data": _data, "train": _train, "attack": _attack, "confirm": _confirm}
    does[config.what](config, Console(stderr=True) if config.json else Console())
    return 0


def _data(config: Classify, console: Console) -> None:
    out = folder_of(config.out, Path("runs") / "classify-pictures")
    claim(out, config, ("train", "val", "test"))
    counts, failed = write_pictures(config, out)
    console.print(f"pictures: {', '.join(f'{count} {split}' for split, count in counts.items())}")
    _end(config, console, out, {"out": str(out), "pictures": counts, "frames_failed": failed}, failed)


def _train(config: Classify, console: Console) -> None:
    data = train_run(config)
    rows = tuple((str(e["epoch"]), f"{e['loss']:.4f}", percent(e["val"])) for e in data["epochs"])
    sheet = Sheet(f"{config.network}: {config.layers} layers", ("epoch", "loss", "accuracy on val, %"), rows)
    console.print(sheet.table(()))
    for split, value in data["accuracy"].items():
        low, high = (percent(end) for end in data["intervals"][split])
        console.print(
            f"accuracy on {split}: {percent(value)} % [{low}, {high}] of {data['pictures'][split]}", markup=False
        )
    _end(config, console, Path(data["weights"]), data, data["frames_failed"])


def _attack(config: Classify, console: Console) -> None:
    found = attack_run(config)
    console.print(_table(found).table(("class",)))
    grades = found.grades
    console.print(
        f"{number_of(found.pictures, 'picture')}, {number_of(found.queries, 'query', 'queries')}, "
        f"{number_of(found.passes, 'pass', 'passes')} in {found.seconds:.0f} s: "
        f"{grades['threshold']} misclassified by threshold, {grades['certain']} for certain",
        soft_wrap=True,
    )
    _end(config, console, Path(found.out) / PAGE, found.to_json(), found.frames_failed)


def _confirm(config: Classify, console: Console) -> None:
    found, facts = confirm_run(config)
    console.print(_table(found).table(("class",)))
    lines = [
        f"{facts['renderer']} agrees on {facts['agree']} of {number_of(facts['failures'], 'failure')}; "
        f"{found.grades['certain']} are certain, {found.grades['confirmed']} confirmed"
    ]
    if facts["iou"]:
        lines.append(
            f"silhouettes of both renderers: IoU {facts['iou']['mean']:.4f} in the mean, "
            f"{facts['iou']['least']:.4f} at least; "
            f"colours: {facts['colour']['mean']:.1f} in the mean, {facts['colour']['most']:.1f} at most "
            "(CIE 1976, mean of an object)"
        )
    console.print("\n".join(lines), soft_wrap=True)
    _end(config, console, Path(found.out) / PAGE, {**found.to_json(), "second": facts}, facts["frames_failed"])


def _end(
    config: Classify, console: Console, written: Path, data: Mapping[str, Any], failed: Mapping[str, str]
) -> None:
    say_end(written, console, failed)
    if config.json:
        print_json(data)


def _table(run: ClassifiedRun) -> Sheet:
    def row(name: str, tally: ClassTally) -> tuple[str, ...]:
        return name, str(tally.pictures), *shares(tally), str(tally.certain), str(tally.confirmed)

    rows = [*(row(one.name, one) for one in run.classes if one.pictures), row("all", run.whole)]
    title = f"{run.network} on {run.objects} objects: {run.method}, {' + '.join(run.params)}"
    columns = ("class", "pictures", "accuracy, %", "attacked, %", "certain", "confirmed")
    shown = len(columns) if run.grades["confirmed"] else len(columns) - 1
    return Sheet(title, columns[:shown], tuple(row[:shown] for row in rows))
