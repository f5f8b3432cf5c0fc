"""`drivesem classify`: render pictures of objects, train classifiers on them, attack these, analyse the runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drivesem.classify.attack import attack_pictures
from drivesem.classify.confirm import confirm_failures
from drivesem.classify.explain import explain_failures
from drivesem.classify.gate import compare_networks
from drivesem.classify.holes import find_pose_regions
from drivesem.classify.pictures import write_pictures
from drivesem.classify.results import ClassCounts, ClassifyMetrics, format_accuracy
from drivesem.classify.training import train_classifier
from drivesem.config.commands import ClassifyConfig
from drivesem.config.devices import check_device
from drivesem.reporting.tables import Console, ReportTable, format_count, format_percent, print_json
from drivesem.run.driver import print_output_folder, publish_report
from drivesem.run.folder import claim_folder, resolve_output_folder
from drivesem.run.run_report import PAGE

_ANALYSES = {"explain": explain_failures, "holes": find_pose_regions, "gate": compare_networks}


def classify_command(config: ClassifyConfig) -> int:
    """Run `drivesem classify`; exit code 1 if a gate is not passed."""
    check_device(config.device)
    if config.what in _ANALYSES:
        report = _ANALYSES[config.what](config)
        publish_report(report, config.json)
        return 0 if report.data.get("passed", True) else 1
    actions = {"data": _write_data_set, "train": _train, "attack": _attack, "confirm": _confirm}
    actions[config.what](config, Console(stderr=True) if config.json else Console())
    return 0


def _write_data_set(config: ClassifyConfig, console: Console) -> None:
    out = resolve_output_folder(config.out, Path("runs") / "classify-pictures")
    claim_folder(out, config, ("train", "val", "test"))
    counts, failed = write_pictures(config, out)
    console.print(f"pictures: {', '.join(f'{count} {split}' for split, count in counts.items())}")
    _print_results(config, console, out, {"out": str(out), "pictures": counts, "frames_failed": failed}, failed)


def _train(config: ClassifyConfig, console: Console) -> None:
    data = train_classifier(config)
    rows = tuple((str(e["epoch"]), f"{e['loss']:.4f}", format_percent(e["val"])) for e in data["epochs"])
    table = ReportTable(f"{config.network}: {config.layers} layers", ("epoch", "loss", "accuracy on val, %"), rows)
    console.print(table.to_rich(()))
    for split, value in data["accuracy"].items():
        low, high = (format_percent(end) for end in data["intervals"][split])
        console.print(
            f"accuracy on {split}: {format_percent(value)} % [{low}, {high}] of {data['pictures'][split]}",
            markup=False,
        )
    _print_results(config, console, Path(data["weights"]), data, data["frames_failed"])


def _attack(config: ClassifyConfig, console: Console) -> None:
    metrics = attack_pictures(config)
    console.print(_build_table(metrics).to_rich(("class",)))
    grades = metrics.grades
    console.print(
        f"{format_count(metrics.overall.pictures, 'picture')}, {format_count(metrics.queries, 'query', 'queries')}, "
        f"{format_count(metrics.passes, 'pass', 'passes')} in {metrics.seconds:.0f} s: "
        f"{grades['threshold']} misclassified by threshold, {grades['certain']} certain",
        soft_wrap=True,
    )
    _print_results(config, console, Path(metrics.out) / PAGE, metrics.to_json(), metrics.frames_failed)


def _confirm(config: ClassifyConfig, console: Console) -> None:
    metrics, facts = confirm_failures(config)
    console.print(_build_table(metrics).to_rich(("class",)))
    lines = [
        f"{facts['renderer']} agrees on {facts['agree']} of {format_count(facts['failures'], 'failure')}; "
        f"{metrics.grades['certain']} are certain, {metrics.grades['confirmed']} confirmed"
    ]
    if facts["iou"]:
        lines.append(
            f"silhouettes of both renderers: IoU {facts['iou']['mean']:.4f} on average, "
            f"{facts['iou']['least']:.4f} at worst; "
            f"colours: {facts['colour']['mean']:.1f} on average, {facts['colour']['most']:.1f} at worst "
            "(CIE 1976, mean of an object)"
        )
    console.print("\n".join(lines), soft_wrap=True)
    _print_results(
        config, console, Path(metrics.out) / PAGE, {**metrics.to_json(), "second": facts}, facts["frames_failed"]
    )


def _print_results(
    config: ClassifyConfig, console: Console, out: Path, data: Mapping[str, Any], failed: Mapping[str, str]
) -> None:
    print_output_folder(out, console, failed)
    if config.json:
        print_json(data)


def _build_table(metrics: ClassifyMetrics) -> ReportTable:
    def row(name: str, counts: ClassCounts) -> tuple[str, ...]:
        return name, str(counts.pictures), *format_accuracy(counts), str(counts.certain), str(counts.confirmed)

    rows = [
        *(row(counts.name, counts) for counts in metrics.classes if counts.pictures),
        row("all", metrics.overall),
    ]
    title = f"{metrics.network} on {metrics.objects} objects: {metrics.method}, {' + '.join(metrics.params)}"
    columns = ("class", "pictures", "accuracy, %", "attacked, %", "certain", "confirmed")
    count = len(columns) if metrics.grades["confirmed"] else len(columns) - 1
    return ReportTable(title, columns[:count], tuple(row[:count] for row in rows))
