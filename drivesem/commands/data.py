"""`drivesem inspect`, `convert` and `export`: data sets, and labels in the formats of other tools."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from rich.table import Table

from drivesem.config.commands import ConvertConfig, ExportConfig, InspectConfig
from drivesem.config.constraints import parse_class_map
from drivesem.config.errors import UsageError
from drivesem.config.options import DATASETS
from drivesem.data.account import DataAccount, write_account
from drivesem.data.label_table import WriteSummary
from drivesem.data.layouts import detect_layout
from drivesem.data.subsets import FrameFilter, open_selection
from drivesem.reporting.drawing import write_picture
from drivesem.reporting.tables import Console, format_count, print_json
from drivesem.run.conversion import ConversionSettings, convert_labels
from drivesem.run.labels import detect_labels_layout
from drivesem.store import local_copy


def inspect_command(config: InspectConfig) -> int:
    """`drivesem inspect`: account for a data set, and draw some of its images."""
    from drivesem.scenes.contact_sheet import draw_contact_sheet

    root = local_copy(config.root)
    layout = detect_layout(root) if config.dataset == "auto" else config.dataset
    if layout is None:
        raise UsageError(config.root, f"a data set as one of {', '.join(DATASETS)}", "none of them")
    dataset = open_selection(layout, config.root, FrameFilter.from_options(config))
    account = dataset.account()
    if config.images:
        write_picture(Path(config.out), draw_contact_sheet(dataset, config.images))
    if config.json:
        print_json({"data": write_account(account), "sheet": config.out if config.images else None})
        return 0
    write_account(account)
    console = Console()
    for table in _account_tables(account):
        console.print(table)
    if config.images:
        console.print(f"contact sheet: {config.out}", soft_wrap=True)
    return 0


def _account_tables(account: DataAccount) -> list[Table]:
    """Make tables of classes and of files."""
    classes = _make_table(f"{account.layout}: classes", ("class", "use", "boxes"))
    for role, rows in account.by_role().items():
        for name, count in sorted(rows.items(), key=lambda row: -row[1]):
            classes.add_row(name, role, f"{count:,}")
    if account.regions:
        classes.add_row("crowds and regions", "ignored", f"{account.regions:,}")
    table = _make_table("files", ("", "number"))
    table.add_row("images", f"{account.frames:,}")
    table.add_row("files read", f"{account.files:,}")
    counts = {
        **{f"split {name}": count for name, count in account.splits.items()},
        "images without labels": account.unlabelled,
        "labels without image": account.without_image,
        **{f"skipped: {reason}": count for reason, count in account.skipped.items()},
        **{f"repaired: {what}": count for what, count in account.repairs.items()},
    }
    for name, count in counts.items():
        if count:
            table.add_row(name, f"{count:,}")
    for key in account.unused_keys:
        table.add_row(f"key not used: {key}", "")
    return [classes, table]


def _make_table(title: str, columns: Sequence[str]) -> Table:
    """Make an empty table with its numbers, in the last column, on the right."""
    table = Table(title=title, title_justify="left")
    for name in columns:
        table.add_column(name, justify="right" if name == columns[-1] else "left")
    return table


def convert_command(config: ConvertConfig) -> int:
    """`drivesem convert`: convert labels and report what is lost."""
    out = Path(config.out)
    if out.suffix.lower() == ".json":
        if config.to_format != "coco":
            raise UsageError("--out", f"a folder for {config.to_format}", config.out)
        if out.exists():
            raise UsageError("--out", "a new file", config.out)
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError("--out", "a new or empty folder", config.out)
    source = Path(config.source)
    layout = detect_labels_layout(source) if config.from_format == "auto" else config.from_format
    conversion = ConversionSettings(
        to_format=config.to_format,
        from_format=layout,
        scores=config.scores,
        size_wh=_size(config.image_size),
        images=None if config.images is None else Path(config.images),
        copy_images=config.copy_images,
        mapping=parse_class_map("--map", config.map),
    )
    written, account = convert_labels(source, out, conversion)
    data = write_account(account, roles=False)
    if config.json:
        print_json({"out": config.out, **asdict(written), "data": data})
    sys.stderr.write(f"{summarise_losses(written)}\n")
    if layout == "run" and config.to_format == "coco" and not config.copy_images and not config.scores:
        sys.stderr.write(f"images are in {source / 'frames'} (--copy-images copies them)\n")
    return 0


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if match is None:
        raise UsageError("--image-size", "WIDTHxHEIGHT", repr(text))
    return int(match[1]), int(match[2])


def summarise_losses(written: WriteSummary) -> str:
    """What was lost and what was assumed, in one line."""

    def join(counts: Mapping[str, int]) -> str:
        return ", ".join(f"{name} of {count}" for name, count in sorted(counts.items()))

    parts = [f"left out: {join(written.lost)}" if written.lost else "nothing left out"]
    parts += [f"assumed: {join(written.assumed)}"] if written.assumed else []
    return f"{format_count(written.files, 'file')}; {'; '.join(parts)}"


def export_command(config: ExportConfig) -> int:
    """`drivesem export`: export the counterexamples of a run."""
    # these double the memory that inspect and convert start with
    from drivesem.run.export import (
        build_tables,
        export_dataset,
        export_gate_package,
        select_frames_by_grade,
        write_tables,
    )
    from drivesem.run.finished import load_runs

    out = Path(config.out or "")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError("--out", "a new or empty folder", out)
    if config.to_format == "gltf":
        return _gltf(config, out)
    (attack_run,) = load_runs([config.run or ""])
    if config.to_format == "gate":
        package = export_gate_package(attack_run, out)
        if config.json:
            print_json(package)
        failures = format_count(package["failures"], "certain failure")
        frames, size = format_count(package["frames"], "frame"), package["bytes"] / 1e6 / package["frames"]
        sys.stderr.write(
            f"{failures} in {frames}, {size:.2f} MB a frame, in {out}\n"
            f"SHA-256 of {out / 'package.json'}: {package['sha256']}\n"
            f"next: drivesem gate {out} --after NEW_DETECTOR\n"
        )
        return 0
    if config.to_format == "tables":
        written = write_tables(build_tables(attack_run, select_frames_by_grade(attack_run, config.grade)), out)
        if config.json:
            print_json({"out": str(out), "files": written})
        sys.stderr.write(f"{', '.join(written)} in {out}\n")
        return 0
    result = export_dataset(attack_run, out, config.to_format, config.grade, parse_class_map("--map", config.map))
    if config.json:
        print_json({"out": str(out), **asdict(result)})
    sys.stderr.write(f"{summarise_losses(result)}; in {out}\n")
    return 0


def _gltf(config: ExportConfig, out: Path) -> int:
    from drivesem.run.export import export_scenes

    written = export_scenes(Path(config.run or ""), out)
    if config.json:
        print_json({"out": str(out), "files": written})
    sys.stderr.write(f"{format_count(len(written), 'scene')} in {out}\n")
    return 0
