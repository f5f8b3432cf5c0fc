"""A finished run of `drivesem attack`, as transfer needs it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from drivesem.config.commands import Attack
from drivesem.config.errors import UsageError
from drivesem.failures.grades import Grade
from drivesem.run.folder import CONFIG
from drivesem.run.labels import MANIFEST, RESULT, names_in
from drivesem.run.lock import held_elsewhere
from drivesem.run.records import from_json
from drivesem.run.results import FrameResult, load_frame
from drivesem.run.tally import graded
from scene_ir import files
from scene_ir.errors import FormatError

METRICS = "metrics.json"
PICTURES = {"benign": "benign.png", "rerendered": "rerender.png", "attacked": "counterexample.png"}
"""A frame's photograph, the same rendered again without any change, and the picture that was found: all lossless,
as the source was judged on them."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame of a run: its folder, what came of it, and its pictures by name (PICTURES)."""

    folder: Path
    result: FrameResult
    pictures: dict[str, Path]


@dataclass(frozen=True, slots=True)
class Run:
    """name: of the folder; detector, method, params: of the attack; frames: in the order of their names."""

    name: str
    folder: Path
    detector: str
    method: str
    params: str
    frames: tuple[Frame, ...]

    def rows(self) -> list[dict[str, Any]]:
        """One flat dict a frame, for `pandas.DataFrame`."""
        return [_row(frame) for frame in self.frames]

    def failure_rows(self) -> list[dict[str, Any]]:
        """One flat dict a failure: its frame, kind, grade, draws, second opinions, box."""
        return [
            {"frame": frame.result.identifier, **failure.flat()}
            for frame in self.frames
            for failure in frame.result.failures
        ]

    def _repr_html_(self) -> str:
        """A table of the frames, for a notebook."""
        rows = self.rows()
        lines = [list(rows[0]), *(["" if v is None else str(v) for v in row.values()] for row in rows)]
        head, *body = ("".join(f"<td>{escape(cell)}</td>" for cell in line) for line in lines)
        table = "".join(f"<tr>{line}</tr>" for line in (head, *body))
        caption = escape(f"{self.name}: {self.method} on {self.detector}, {self.params}")
        return f"<table><caption>{caption}</caption><tbody>{table}</tbody></table>"


def _row(frame: Frame) -> dict[str, Any]:
    result = frame.result
    kinds = [failure.kind for failure in result.failures]
    return {
        "frame": result.identifier,
        "objects": result.objects,
        "success_moved": result.success_moved,
        "success_paper": result.success_paper,
        "lost": kinds.count("lost"),
        "phantoms": kinds.count("phantom"),
        **_grades(result),
        "passes": result.passes,
        "feasible": result.feasible,
        "queries": result.queries,
        "loss_first": result.loss_trace[0] if result.loss_trace else None,
        "loss_best": max(result.loss_trace, default=None),
        "identity_psnr_db": result.identity_psnr_db,
        "seconds": result.seconds,
        "picture": str(frame.pictures["attacked"]),
    }


def _grades(result: FrameResult) -> dict[str, int | None]:
    """Failures of at least each grade from certain on, and by kind; None where they are unknown."""
    told = graded([result])
    counts = {grade: count for grade, count in told["grades"].items() if grade != Grade.THRESHOLD}
    counts |= told["kinds"]
    return counts if result.graded else dict.fromkeys(counts)


def load_run(folder: str | Path, limit: int | None = None) -> Run:
    """A finished run of `drivesem attack`; limit: its first frames only.

        run = ds.load_run("runs/a")
        pandas.DataFrame(run.rows())

    Raises UsageError for a folder that holds no finished run and a limit below 1, FormatError naming a file that
    is damaged.
    """
    if limit is not None and limit < 1:
        raise UsageError("limit", "at least 1", limit)
    return load_runs([str(folder)], limit, "folder")[0]


def load_runs(
    folders: Sequence[str], limit: int | None = None, setting: str = "--run", may_be_empty: bool = False
) -> list[Run]:
    """Runs by folder; limit: the first frames of each; setting: what names them on the command line. may_be_empty:
    also runs without frames, as a part may be. Raises UsageError for a folder that holds no finished run,
    FormatError naming a file that is not as `drivesem attack` writes it.
    """
    paths = [Path(folder) for folder in folders]
    doubled = sorted({str(path) for path in paths if sum(p.resolve() == path.resolve() for p in paths) > 1})
    if doubled:
        raise UsageError(setting, "each run once", doubled[0])
    # Runs of the same name in different folders are told apart by their whole paths.
    plain = [path.resolve().name for path in paths]
    names = [name if plain.count(name) == 1 else str(path) for name, path in zip(plain, paths, strict=True)]
    runs = [_load(path, name, limit, setting) for path, name in zip(paths, names, strict=True)]
    for run in runs:
        if not run.frames and not may_be_empty:
            raise UsageError(setting, "a run with frames", f"{run.folder}, which has none")
    return runs


def _load(folder: Path, name: str, limit: int | None, setting: str) -> Run:
    for file in (CONFIG, METRICS, MANIFEST):
        files.below(folder, file)
    if not (folder / CONFIG).is_file():
        raise UsageError(setting, "a folder of drivesem attack", folder)
    settings = files.read_yaml(folder / CONFIG)
    if not isinstance(settings, dict) or not {"detector", "dataset", "params", "combo"} <= settings.keys():
        raise UsageError(setting, "a folder of drivesem attack", f"{folder}, a run of another command")
    if not (folder / METRICS).is_file() or not (folder / MANIFEST).is_file():
        if held_elsewhere(folder):
            raise UsageError(setting, "a finished run", f"{folder}, into which an attack is still writing")
        raise UsageError(
            setting, "a finished run (the same command finishes it)", f"{folder}, which stopped early"
        )
    identifiers, metrics = names_in(folder), files.read_json(folder / METRICS)
    try:
        params = ",".join(metrics["params"])
    except (KeyError, TypeError) as error:
        raise FormatError(str(folder / METRICS), "params of a run", error) from error
    from_json(float | None, metrics.get("t_star"), f"{folder / METRICS}: t_star")
    return Run(
        name=name,
        folder=folder,
        detector=from_json(str, settings["detector"], f"{folder / CONFIG}: detector"),
        # Runs from before there was a choice followed the default.
        method=str(settings.get("method", Attack().method)),
        params=params,
        frames=tuple(_frame(folder / "frames" / identifier) for identifier in identifiers[:limit]),
    )


def _frame(folder: Path) -> Frame:
    files.check_links(folder)
    pictures = {name: folder / file for name, file in PICTURES.items()}
    for path in pictures.values():
        if not path.is_file():
            raise FormatError(str(path), "a picture of the run", "none")
    return Frame(folder, load_frame(folder / RESULT), pictures)
