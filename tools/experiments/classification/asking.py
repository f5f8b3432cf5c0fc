"""`drivesem study classification`: the paper's experiments on image classifiers, and its figures beside ours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from drivesem.report.tables import AnalysisReport
from drivesem.run.folder import ARMS, PRESENTATION, RETRAINED, claim_folder, resolve_output_folder
from tools.experiments.classification.kept import keep_results, load_results
from tools.experiments.classification.lab import PICTURES, TABLES, Lab
from tools.experiments.classification.looking import LOOKED
from tools.experiments.classification.results import StudyFacts, ClassificationResults
from tools.experiments.classification.tables import ORDERS, tables_of
from tools.experiments.detection.kept_rows import KEPT, command_of
from tools.experiments.settings import StudyConfig

_WRITTEN = (
    *("study.md", "study.json", *(f"{name}.csv" for name in (*TABLES, ORDERS))),
    *(ARMS, KEPT, LOOKED, RETRAINED, PICTURES),
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


def study_run(study: StudyConfig) -> AnalysisReport:
    """Run or continue it, and write what is said; tell one that was kept, and write it where --out is given.

    Raises UsageError or SceneError for bad input.
    """
    if study.kept is not None:
        return _again(study, Path(study.kept))
    lab = Lab.of(study)
    claim_folder(lab.out, lab.study, _WRITTEN, _FREE)
    lab.attack()
    lab.teach()
    results = ClassificationResults(StudyFacts.from_study(study, lab), lab)
    answer = _answer(results, lab.out)
    keep_results(lab.out / KEPT, results)
    answer.write()
    return answer


def _again(study: StudyConfig, folder: Path) -> AnalysisReport:
    results = load_results(folder)
    if study.bootstrap is not None:
        told = replace(results.facts.study, bootstrap=study.bootstrap)
        results.facts = replace(results.facts, study=told)
    answer = _answer(results, resolve_output_folder(study.out, folder))
    if study.out is not None:
        answer.write()
    return answer


def _answer(results: ClassificationResults, out: Path) -> AnalysisReport:
    found, facts = tables_of(results), results.facts
    return AnalysisReport(
        out=out,
        name="study",
        heading="Image classifiers",
        data={
            "study": facts.study.name,
            "out": str(out),
            "networks": [one.name for one in facts.networks],
            "objects": facts.study.objects or "embedded",
            "pictures": facts.counts,
            "bootstrap": results.bootstrap.draws,
            "tables": {
                one.name: {"rows": one.rows, "reference": one.reference, "notes": one.notes} for one in found
            },
            "frames_failed": facts.failed,
        },
        csv_tables={one.name: one.rows for one in found if one.rows},
        tables=[one.sheet() for one in found],
        notes=[_NOTE.format(draws=results.bootstrap.draws), *(note for one in found for note in one.notes)],
        text_columns=_WORDS,
        printed_tables=[one.sheet(classes=False) for one in found if one.name != ORDERS],
        intro=[f"`{command_of(facts.study)}`", ""],
        failed=facts.failed,
    )
