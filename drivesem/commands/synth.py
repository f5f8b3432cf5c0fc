"""`drivesem synth`: generated frames in a data set's layout."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from drivesem.config.commands import SynthConfig
from drivesem.config.errors import UsageError
from drivesem.reporting.tables import Console, format_count, print_json, progress_bar
from drivesem.run.folder import resolve_output_folder
from drivesem.run.lock import acquire_folder_lock
from drivesem.run.workers import make_parallel_map
from drivesem.synth.assets import meshes_in, notes_in, of_split
from drivesem.synth.variations import MIXED, parse_variations
from drivesem.synth.write import Order, synthesise

_DRIVE_FRAMES = 10
"""Frames of one drive in the layouts of Virtual KITTI, without --sequence."""
_SHEET_FRAMES = 8


def build_order(config: SynthConfig) -> Order:
    """The data set that the settings describe. Raises UsageError or SceneError for bad input."""
    out = resolve_output_folder(config.out, Path(f"data/synth-{config.layout}-{config.split}-seed{config.seed}"))
    virtual = config.layout.startswith("vkitti")
    for name in ("meshes", "assets"):
        folder = getattr(config, name)
        if folder is not None and not Path(folder).is_dir():
            raise UsageError(f"--{name}", "a folder", folder)
    return Order(
        out=out,
        frames=config.frames if config.limit is None else min(config.frames, config.limit),
        seed=config.seed,
        layout=config.layout,
        split=config.split,
        variations=parse_variations(config.variations or ("clone" if virtual else MIXED)),
        sequence=config.sequence or (_DRIVE_FRAMES if virtual else 1),
        people=not virtual if config.people is None else config.people,
        varied_people=config.varied_people,
        cameras=config.cameras,
        validation=config.validation,
        night=config.night,
        edits=None if config.edits is None else Path(config.edits),
        meshes=None if config.meshes is None else Path(config.meshes),
        assets=None if config.assets is None else Path(config.assets),
        resume=config.resume,
    )


def synth_command(config: SynthConfig) -> int:
    """`drivesem synth`: generate the frames that do not exist yet."""
    start = time.perf_counter()
    order = build_order(config)
    _write_mesh_notes(order)
    total = len(order.places())
    acquire_folder_lock(order.out)
    done = synthesise(order, make_parallel_map(config))
    with progress_bar(Console(stderr=True), show_remaining=True) as progress:
        for _ in progress.track(done, total=total, description="making frames"):
            pass
    result: dict[str, object] = {"out": str(order.out), "frames": total}
    if config.sheet:
        result["sheet"] = str(_sheet(order))
    if config.compare:
        result["distances"] = _compare(order)
    result["seconds"] = round(time.perf_counter() - start, 3)
    if config.json:
        print_json(result)
    else:
        Console().print(
            f"{format_count(total, 'frame')} in {order.out} ({result['seconds']:.0f} s)", soft_wrap=True
        )
    return 0


def _write_mesh_notes(order: Order) -> None:
    """Write to stderr what the meshes lack, and how many of them belong to the other split."""
    assets = None if order.assets is None else order.assets / "vehicles"
    option, folder = ("--assets", assets) if order.meshes is None else ("--meshes", order.meshes)
    if folder is None or not folder.is_dir():
        return
    sys.stderr.writelines(f"{option}: {note}\n" for note in notes_in(folder))
    vehicles = meshes_in(folder)
    others = len(vehicles) - len(of_split(vehicles, order.split))
    if others and not order.validation:
        sys.stderr.write(
            f"{option}: {others} of {len(vehicles)} meshes belong to the other split by their names\n"
        )


def _sheet(order: Order) -> Path:
    """Write a contact sheet of the frames, as the layout's reader reads them."""
    from drivesem.data.registry import open_dataset
    from drivesem.reporting.drawing import write_picture
    from drivesem.synth.sheet import draw_sheet

    dataset = open_dataset(order.layout, order.out)
    names = dataset.identifiers
    step = max(len(names) // _SHEET_FRAMES, 1)
    path = order.out / "sheet.jpg"
    write_picture(path, draw_sheet(dataset, names[::step][:_SHEET_FRAMES]))
    return path


def _compare(order: Order) -> dict[str, object]:
    """Write a plot and a table of the distributions, compared with KITTI's."""
    from drivesem.data.registry import open_dataset
    from drivesem.synth.compare import compare
    from scene_ir import files

    comparison = compare(open_dataset(order.layout, order.out))
    comparison.plot(order.out / "distributions.png")
    files.write_text(order.out / "distributions.md", comparison.table())
    return comparison.summary()["distances"]
