"""The model card: what a weights file is, what it was made from, how good it is, and how to make it again."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from detectors.base import Detector
from drivesem.attack.labels import Difficulty
from drivesem.evaluation.coco import ClassScores
from drivesem.training.judging import Marks
from drivesem.training.targets import TRAINED
from scene_ir import files

_CARD = """# {title}

- Architecture: {name}, {parameters:,} parameters; classes {classes}.
- Weights: `{file}`, float16, safetensors. Licence: Apache-2.0, as the whole project.
  SHA-256: `{sha256}`
- Start: {start}
- Data: {data}
  Vans count as Car. Objects lower than {minimum:g} px or of unknown occlusion were ignored.
- Training: {step:,} steps of {batch} views, {minutes:.0f} minutes on {machine}, seed {seed}.{note}

## Figures

{figures}
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
class Recipe:
    """What a card says besides figures. data: a sentence on the frames; start: one on the first weights; machine:
    what it was trained on; commands: lines that train it again; also: a phrase for further frames.
    """

    data: str
    start: str
    batch: int
    seed: int
    machine: str
    commands: tuple[str, ...]
    by_clock: bool
    note: str = ""
    also: str = "further frames"
    judged: Difficulty = field(default_factory=Difficulty)


def card(
    detector: Detector,
    recipe: Recipe,
    weights: Path,
    done: tuple[int, float],
    held_out: tuple[int, Marks] | None,
    also: tuple[int, ClassScores] | None,
    chosen_on: int | None = None,
) -> str:
    """The card as Markdown. weights: their file, written; done: steps and seconds; held_out, also: how many
    frames, and their figures; chosen_on: how many others chose step and t*, None where those of held_out did.
    """
    step, seconds = done
    return _CARD.format(
        title=f"{detector.name}: weights and how they were made",
        name=detector.name,
        parameters=sum(p.numel() for p in detector.parameters()),
        classes=", ".join(detector.classes),
        file=weights.name,
        sha256=files.digest(weights),
        start=recipe.start,
        data=recipe.data,
        minimum=TRAINED.min_height_px,
        step=step,
        batch=recipe.batch,
        minutes=seconds / 60,
        machine=recipe.machine,
        seed=recipe.seed,
        note=f"\n  {recipe.note}" if recipe.note else "",
        figures=_figures(recipe, held_out, also, chosen_on),
        commands="\n".join(recipe.commands),
        repeatable=(
            "The schedule follows the clock, so another run gives other weights of the same quality, not the same "
            f"bytes; with\n`--minutes 0 --steps {step}` it is repeatable."
            if recipe.by_clock
            else "The same version, machine and number of threads give the same weights."
        ),
    )


def _figures(
    recipe: Recipe,
    held_out: tuple[int, Marks] | None,
    also: tuple[int, ClassScores] | None,
    chosen_on: int | None,
) -> str:
    if held_out is None:
        return "None: no frames were held out. t* = 0.5 was not chosen on any.\n"
    frames, marks = held_out
    judged = recipe.judged
    lines = [
        f"{frames} held-out frames, judged at least {judged.min_height_px:g} px high, occlusion at most "
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
    told = [f"{best} these frames. The step was chosen on", "them too, so their figures are slightly optimistic."]
    if chosen_on is not None:
        told = [f"{best} {chosen_on} further frames,", "which chose the step too: these had no say."]
    lines += ["", *told, ""]
    if also is not None and also[1].objects:
        count, s = also
        lines += [
            f"{count} {recipe.also}, never trained or tuned on, judged in the same way: Car AP50 "
            f"{s.ap50:.3f}, recall {s.recall:.3f} ({s.objects} cars).",
            "",
        ]
    return "\n".join(lines)
