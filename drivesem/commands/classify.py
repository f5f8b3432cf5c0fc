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
from drivesem.config.commands import ClassifyConfig
from drivesem.config.devices import check_device
from drivesem.report.tables import ReportTable, format_count, format_percent, print_json
from drivesem.report.terminal import Console
from drivesem.run.driver import print_output_folder, publish_report
from drivesem.run.folder import claim_folder, resolve_output_folder
from drivesem.run.report.runs import PAGE

_ASKED = {"explain": explain_run, "holes": holes_run, "gate": gate_run}


def classify_command(config: ClassifyConfig) -> int:
    """Draw, train, attack, or ask about a run; exit code 0, and 1 where a gate is not passed.
    Raises UsageError or SceneError for bad input."""
    check_device(config.device)
    if config.what in _ASKED:
        answer = _ASKED[config.what](config)
        publish_report(answer, config.json)
        return 0 if answer.data.get("passed", True) else 1
    does = {"data": _data, "train": _train, "attack": _attack, "confirm": _confirm}
    does[config.what](config, Console(stderr=True) if config.json else Console())
    return 0


def _data(config: ClassifyConfig, console: Console) -> None:
    out = resolve_output_folder(config.out, Path("runs") / "classify-pictures")
    claim_folder(out, config, ("train", "val", "test"))
    counts, failed = write_pictures(config, out)
    console.print(f"pictures: {', '.join(f'{count} {split}' for split, count in counts.items())}")
    _end(config, console, out, {"out": str(out), "pictures": counts, "frames_failed": failed}, failed)


def _train(config: ClassifyConfig, console: Console) -> None:
    data = train_run(config)
    rows = tuple((str(e["epoch"]), f"{e['loss']:.4f}", format_percent(e["val"])) for e in data["epochs"])
    sheet = ReportTable(f"{config.network}: {config.layers} layers", ("epoch", "loss", "accuracy on val, %"), rows)
    console.print(sheet.to_rich(()))
    for split, value in data["accuracy"].items():
        low, high = (format_percent(end) for end in data["intervals"][split])
        console.print(
            f"accuracy on {split}: {format_percent(value)} % [{low}, {high}] of {data['pictures'][split]}",
            markup=False,
        )
    _end(config, console, Path(data["weights"]), data, data["frames_failed"])


def _attack(config: ClassifyConfig, console: Console) -> None:
    found = attack_run(config)
    console.print(_table(found).to_rich(("class",)))
    grades = found.grades
    console.print(
        f"{format_count(found.pictures, 'picture')}, {format_count(found.queries, 'query', 'queries')}, "
        f"{format_count(found.passes, 'pass', 'passes')} in {found.seconds:.0f} s: "
        f"{grades['threshold']} misclassified by threshold, {grades['certain']} for certain",
        soft_wrap=True,
    )
    _end(config, console, Path(found.out) / PAGE, found.to_json(), found.frames_failed)


def _confirm(config: ClassifyConfig, console: Console) -> None:
    found, facts = confirm_run(config)
    console.print(_table(found).to_rich(("class",)))
    lines = [
        f"{facts['renderer']} agrees on {facts['agree']} of {format_count(facts['failures'], 'failure')}; "
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
    config: ClassifyConfig, console: Console, written: Path, data: Mapping[str, Any], failed: Mapping[str, str]
) -> None:
    print_output_folder(written, console, failed)
    if config.json:
        print_json(data)


def _table(run: ClassifiedRun) -> ReportTable:
    def row(name: str, tally: ClassTally) -> tuple[str, ...]:
        return name, str(tally.pictures), *shares(tally), str(tally.certain), str(tally.confirmed)

    rows = [*(row(one.name, one) for one in run.classes if one.pictures), row("all", run.whole)]
    title = f"{run.network} on {run.objects} objects: {run.method}, {' + '.join(run.params)}"
    columns = ("class", "pictures", "accuracy, %", "attacked, %", "certain", "confirmed")
    shown = len(columns) if run.grades["confirmed"] else len(columns) - 1
    return ReportTable(title, columns[:shown], tuple(row[:shown] for row in rows))
