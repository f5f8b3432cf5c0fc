"""Model cards: what weights are, what they were trained on, how good they are, and how to train them again.

Also the training curves, and the check whether frames to evaluate on belong to the data that a card names.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from detectors.base import Detector
from detectors.registry import SHIPPED
from drivesem.attacks.labels import Difficulty
from drivesem.evaluation.coco import ClassScores, CocoScores
from drivesem.reporting.plots import LINE_STYLES, PLOT_COLOURS, PLOT_STYLE
from drivesem.reporting.tables import Console
from drivesem.training.frames import TRAINING_LIMITS
from scene_ir import files

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_CARD = """# {title}

- Architecture: {name}, {parameters:,} parameters; classes {classes}.
- Weights: `{file}`, float16, safetensors. Licence: Apache-2.0, as the whole project.
  SHA-256: `{sha256}`
- Start: {start}
- Data: {data}
  Vans count as Car. Objects lower than {minimum:g} px or of unknown occlusion were ignored.
- Training: {step:,} steps of {batch} views, {minutes:.0f} minutes on {machine}, seed {seed}.{note}

## Metrics

{metrics}
## Limits

Small, hidden, or unusual objects are missed more often, and so is what looks unlike the frames it was trained on.
Not for use in a vehicle.

## Train it again

```
{commands}
```
{repeatable}
"""


@dataclass(frozen=True)
class ValidationScores:
    """COCO's metrics on held-out frames, and the best F1 over all classes."""

    scores: CocoScores
    """COCO's metrics."""
    f1: float
    """Best F1."""
    t_star: float
    """Score of the best F1."""

    @property
    def selection_score(self) -> float:
        """The criterion for the best weights: the headline's AP50, plus a quarter of the mean over classes."""
        return (self.scores.headline.ap50 or 0.0) + 0.25 * (self.scores.overall.ap50 or 0.0)

    def summary(self) -> str:
        """Format the metrics on one line."""
        rows = [
            f"{name} AP50 {s.ap50:.4f} recall {s.recall:.4f} ({s.objects})"
            for name, s in self.scores.per_class.items()
            if s.objects
        ]
        return ", ".join(rows) + f", F1 {self.f1:.4f} at {self.t_star:.3f}"


@dataclass(frozen=True)
class CardFacts:
    """What a card states besides metrics."""

    data: str
    """Sentence on the frames."""
    start: str
    """Sentence on the first weights."""
    batch: int
    """Views per step."""
    seed: int
    """Seed of the training."""
    machine: str
    """What it was trained on."""
    commands: tuple[str, ...]
    """Commands that train it again."""
    by_clock: bool
    """Whether the schedule follows the clock."""
    note: str = ""
    """Remark."""
    also: str = "further frames"
    """Phrase for the further frames."""
    judged: Difficulty = field(default_factory=Difficulty)
    """Limits of the evaluated objects."""


def format_card(
    detector: Detector,
    recipe: CardFacts,
    weights: Path,
    done: tuple[int, float],
    held_out: tuple[int, ValidationScores] | None,
    also: tuple[int, ClassScores] | None,
    chosen_on: int | None = None,
) -> str:
    """Format the card as Markdown.

    Args:
        detector: The trained detector.
        recipe: Facts of the training.
        weights: File of the weights, already written.
        done: Steps and seconds of the training.
        held_out: Number of held-out frames and their metrics.
        also: Number of further frames and their metrics.
        chosen_on: Number of other frames that selected step and t*; None where the held-out ones did.
    """
    step, seconds = done
    return _CARD.format(
        title=f"{detector.name}: weights and how they were made",
        name=detector.name,
        parameters=sum(p.numel() for p in detector.parameters()),
        classes=", ".join(detector.classes),
        file=weights.name,
        sha256=files.sha256_digest(weights),
        start=recipe.start,
        data=recipe.data,
        minimum=TRAINING_LIMITS.min_height_px,
        step=step,
        batch=recipe.batch,
        minutes=seconds / 60,
        machine=recipe.machine,
        seed=recipe.seed,
        note=f"\n  {recipe.note}" if recipe.note else "",
        metrics=_format_metrics(recipe, held_out, also, chosen_on),
        commands="\n".join(recipe.commands),
        repeatable=(
            "The schedule follows the clock, so another run gives other weights of the same quality, not the same "
            f"bytes; with\n`--minutes 0 --steps {step}` it is repeatable."
            if recipe.by_clock
            else "The same version, machine and number of threads give the same weights."
        ),
    )


def _format_metrics(
    recipe: CardFacts,
    held_out: tuple[int, ValidationScores] | None,
    also: tuple[int, ClassScores] | None,
    chosen_on: int | None,
) -> str:
    if held_out is None:
        return "None: no frames were held out. t* = 0.5 was not chosen on any.\n"
    frames, marks = held_out
    judged = recipe.judged
    lines = [
        f"{frames} held-out frames, evaluated from {judged.min_height_px:g} px high, occlusion at most "
        f"{judged.max_occlusion}, truncation at most",
        f"{judged.max_truncation:g} (others are ignored), IoU 0.5:",
        "",
        "| class | objects | AP50 | AP | recall | recall at t* |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    lines += [
        f"| {name} | {s.objects} | {s.ap50:.4f} | {s.ap:.4f} | {s.recall:.4f} | {s.recall_at_t_star:.4f} |"
        for name, s in marks.scores.per_class.items()
        if s.objects
    ]
    best = f"t* = {marks.t_star:.3f}: the score of best F1 ({marks.f1:.3f}) over all classes on"
    selection = [
        f"{best} these frames. The step was selected on",
        "them too, so metrics are slightly optimistic.",
    ]
    if chosen_on is not None:
        selection = [f"{best} {chosen_on} further frames,", "which selected the step too: these played no part."]
    lines += ["", *selection, ""]
    if also is not None and also[1].objects:
        count, s = also
        lines += [
            f"{count} {recipe.also}, never trained or tuned on, evaluated in the same way: Car AP50 "
            f"{s.ap50:.3f}, recall {s.recall:.3f} ({s.objects} cars).",
            "",
        ]
    return "\n".join(lines)


_SIZE_IN, _DPI = (7.0, 7.4), 130
_SMOOTHED_OVER = 0.02
"""Share of the run that the thick line averages over."""
_FACTS = ("step", "seconds", "rate", "norm")
"""Columns of the log that are not terms of the loss."""
_MOST_DIGITS = 2
EVALUATED = ("car_ap50", "car_recall", "ap50", "f1")
"""Columns of the evaluations that are plotted."""


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """Read a CSV of numbers by column; empty fields are NaN. Empty where there is no such file."""
    if not path.is_file():
        return {}
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = list(rows[0]) if rows else []
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}


def moving_average(values: Sequence[float] | np.ndarray, over: int) -> np.ndarray:
    """Moving average over `over` values, fewer at the ends."""
    sums = np.cumsum(np.concatenate([[0.0], np.asarray(values, np.float64)]))
    place = np.arange(len(sums) - 1)
    first, last = np.maximum(place - over // 2, 0), np.minimum(place + (over - over // 2), len(place))
    return (sums[last] - sums[first]) / (last - first)


def plot_curves(log: Path, evaluations: Path, out: Path, title: str) -> None:
    """Plot terms of the loss, evaluations and the learning rate over steps as PNG, once the log has a step.

    Args:
        log: CSV of the steps.
        evaluations: CSV of the evaluations.
        out: The PNG file.
        title: Title of the plot.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    steps, judged = read_columns(log), read_columns(evaluations)
    if not steps:
        return
    with mpl.rc_context(dict(PLOT_STYLE)):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        heights = (3, 2.2, 1) if judged else (3, 1)
        panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
        loss, rate = panels[0], panels[-1]
        over = max(round(len(steps["step"]) * _SMOOTHED_OVER), 1)
        terms = [name for name in steps if name not in _FACTS]
        for i, name in enumerate(terms):
            colour = PLOT_COLOURS[i % len(PLOT_COLOURS)]
            loss.plot(steps["step"], steps[name], color=colour, linewidth=0.6, alpha=0.25)
            loss.plot(
                steps["step"],
                moving_average(steps[name], over),
                LINE_STYLES[i % len(LINE_STYLES)],
                color=colour,
                label=name,
                linewidth=1.8,
            )
        loss.set(ylabel="loss", yscale="log")
        loss.set_title(title, loc="left", fontsize=11)
        loss.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=max(len(terms), 1))
        if judged:
            _draw_marks(panels[1], judged)
        rate.plot(steps["step"], steps["rate"], color=PLOT_COLOURS[0], linewidth=1.5)
        rate.set(ylabel="rate", xlabel="steps", ylim=(0, None))
        rate.ticklabel_format(axis="y", style="sci", scilimits=(-_MOST_DIGITS, _MOST_DIGITS))
        buffer = io.BytesIO()
        # no date and no version in the file: equal data give equal bytes
        figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    files.write_bytes(out, buffer.getvalue())


def _draw_marks(axes: Axes, judged: Mapping[str, np.ndarray]) -> None:
    for i, name in enumerate(name for name in EVALUATED if name in judged):
        axes.plot(
            judged["step"],
            100 * judged[name],
            LINE_STYLES[i % len(LINE_STYLES)],
            color=PLOT_COLOURS[i],
            label=name.replace("_", " ").replace("ap50", "AP50").replace("car", "Car").replace("f1", "F1"),
            linewidth=1.8,
            marker="o",
            markersize=4,
        )
    axes.set(ylabel="held out, %", ylim=(0, 102))
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(EVALUATED))


SHARED = ("split", "seed", "vehicles", "building", "tree", "bush", "surface")
"""Keys of a manifest's frame for its origin and its shapes."""
MANIFEST = "manifest.json"
_NAMED = re.compile(r"`([\w.-]+_data\.json)`")
"""Files next to a model card that describe generated frames."""


def describe_data(folders: Iterable[Path], frames: int | None = None) -> dict[str, Any]:
    """Collect splits, seeds and shapes over folders of `drivesem synth`, from the first `frames` frames of each."""
    manifests = [files.read_json(folder / MANIFEST)["frames"] for folder in folders]
    entries = [entry for manifest in manifests for entry in manifest[:frames]]
    union: dict[str, Any] = {"frames": len(entries)}
    for key in SHARED:
        values = [entry[key] for entry in entries]
        union[key] = sorted({v for value in values for v in (value if isinstance(value, list) else [value])})
    return union


def generated_folders(folders: str | None) -> list[Path]:
    """Split comma-separated folders; empty unless `drivesem synth` made all of them."""
    found = [Path(part) for part in (folders or "").split(",") if part]
    return found if found and all((folder / MANIFEST).is_file() for folder in found) else []


def street_seeds(described: dict[str, Any]) -> set[tuple[str, int]]:
    """Split and seed of the streets in a description; data sets that share one share streets."""
    return {(split, seed) for split in described["split"] for seed in described["seed"]}


def list_overlaps(detector: str, folders: str | None) -> list[str]:
    """List the streets of generated folders that a detector's model card names as its own, to train on or to select
    by; one line each. Empty where the card or the folders are unknown.
    """
    here = generated_folders(folders)
    card = SHIPPED.get(detector, Path(detector)).with_suffix(".md")
    if not here or not card.is_file():
        return []
    own, lines = street_seeds(describe_data(here)), []
    for name in dict.fromkeys(_NAMED.findall(files.read_text(card))):
        path = card.with_name(name)
        for split, seed in sorted(own & street_seeds(files.read_json(path)) if path.is_file() else ()):
            lines.append(
                f"{folders}: streets of split {split}, seed {seed}, are among those of {name}, which the card of "
                f"{detector} names: metrics on them are not of held-out frames"
            )
    return lines


def warn_about_overlaps(detectors: Sequence[str], folders: str | None, console: Console) -> None:
    """Print the lines of `list_overlaps` for several detectors.

    Args:
        detectors: Names or files of the detectors.
        folders: Comma-separated folders.
        console: Where the lines appear.
    """
    for line in dict.fromkeys(line for one in detectors for line in list_overlaps(one, folders)):
        console.print(line, soft_wrap=True, markup=False, highlight=False)
