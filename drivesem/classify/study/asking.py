"""`drivesem study classification`: the paper's experiments on image classifiers, and its figures beside ours."""

from __future__ import annotations

from drivesem.classify.study.arms import ARMS
from drivesem.classify.study.lab import PICTURES, TABLES, Lab
from drivesem.classify.study.looking import LOOKED
from drivesem.classify.study.retraining import RETRAINED
from drivesem.classify.study.tables import ORDERS, flat, remarks, tables_of
from drivesem.report.answer import Answer
from drivesem.run.folder import PRESENTATION, claim
from drivesem.settings.commands import Study
from drivesem.settings.text import command_line

_WRITTEN = (
    *("study.md", "study.json", *(f"{name}.csv" for name in (*TABLES, ORDERS))),
    *(ARMS, LOOKED, RETRAINED, PICTURES),
)
_FREE = (*PRESENTATION, "bootstrap", "tables", "networks", "fresh")
"""Settings that may change on the way: they add attacks, and alter none."""
_WORDS = (
    *("network", "strategy", "trained on", "parameters", "settings", "made against", "asked", "class"),
    *("membership", "realism weight", "metric", "table", "first", "second", "the paper's order"),
)
"""Columns of words."""
_NOTE = (
    "Overall: the mean over classes weighed by their sizes, which is the share of all pictures; in brackets 95 % "
    "of {draws} draws of objects. A picture that is misclassified as it is counts as wrong before and after. The "
    "paper's figures are of ShapeNet's objects, photographs and another renderer: they stand beside ours, and are "
    "no target."
)


def study_run(study: Study) -> Answer:
    """Run or continue it, and write what is said. Raises UsageError or SceneError for bad input."""
    lab = Lab.of(study)
    claim(lab.out, lab.study, _WRITTEN, _FREE)
    lab.attack()
    lab.teach()
    found = tables_of(lab)
    command = command_line("study", study, ("out", "json", "resume", "workers", "name"))
    answer = Answer(
        out=lab.out,
        name="study",
        heading="Image classifiers",
        data={
            "study": study.name,
            "out": str(lab.out),
            "networks": [eyes.name for eyes in lab.eyes],
            "objects": study.objects or "embedded",
            "pictures": {"test": len(lab.done), "train": len(lab.train), "retrained": len(lab.few)},
            "bootstrap": lab.drawing.draws,
            "tables": {
                one.name: {"rows": one.rows, "reference": one.reference, "notes": remarks(one)} for one in found
            },
            "frames_failed": dict(sorted(lab.failed.items())),
        },
        tables={one.name: flat(one.rows) for one in found if one.rows},
        sheets=[one.sheet() for one in found],
        notes=[_NOTE.format(draws=lab.drawing.draws), *(note for one in found for note in remarks(one))],
        words=_WORDS,
        printed=[one.sheet(classes=False) for one in found if one.name != ORDERS],
        lead=[f"`{command.replace('study', f'study {study.name}', 1)}`", ""],
        failed=dict(sorted(lab.failed.items())),
    )
    answer.write()
    return answer
