"""What people said of the survey's pictures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drivesem.config.errors import UsageError
from drivesem.evaluation.resampling import DRAWS
from drivesem.report.tables import AnalysisReport, ReportTable, format_count
from drivesem.run.folder import resolve_output_folder
from tools.experiments.settings import SurveyResultsConfig
from tools.experiments.survey.page import (
    KEY,
    Response,
    read_answers,
    read_key,
    summary,
)

_WORDS = ("what", "item", "kind", "frame", "truth")
_PAPER = {
    "named_right": 0.98,
    "realism_mean": {"classification": 6.35, "detection": 4.74},
    "realism_average_median": {"classification": 6.67, "detection": 4.26},
}
"""Section 4.2 and appendix of the paper: 30 people, 15 counterexamples each."""
_NOTE = (
    "Intervals: 95 % of the bootstrap over people. Average median: mean over pictures of the median over people, "
    "as in the paper. Alpha: Krippendorff's, 1 where all agree, 0 as by chance. The paper: 98 % named rightly; "
    "realism 6.35, average median 6.67 (classification, rendered meshes), 4.74 and 4.26 (detection)."
)


def survey_results(config: SurveyResultsConfig) -> AnalysisReport:
    """Read and count answers, and write what is said of them. Raises UsageError or SceneError for bad input."""
    place = Path(config.survey or "")
    key = place / KEY if place.is_dir() else place
    name, items = read_key(key)
    answers: list[Response] = []
    for path in config.answers:
        more = read_answers(Path(path), name, items)
        known = {(answer.participant, answer.item) for answer in answers}
        for answer in more:
            if (answer.participant, answer.item) in known:
                raise UsageError(path, "people who answered once", f"{answer.participant} again")
        answers += more
    if not answers:
        raise UsageError("ANSWERS", "files with answers", "none in them")
    out = resolve_output_folder(config.out, key.parent / "results")
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    data = {"survey": name, "bootstrap": draws, **summary(items, answers, draws, config.seed), "paper": _PAPER}
    figures = _figures(data)
    answer = AnalysisReport(
        out=out,
        name="survey",
        heading="Survey",
        data=data,
        csv_tables={"survey": data["items"]},
        tables=[figures, _items(data)],
        printed_tables=[figures],
        notes=[_NOTE],
        text_columns=_WORDS,
        json_only=True,
    )
    answer.write()
    return answer


def _figures(data: Mapping[str, Any]) -> ReportTable:
    kinds = data["kinds"]
    lines = (
        ("pictures", "items", 1, 0),
        ("answers", "answers", 1, 0),
        ("people", "people", 1, 0),
        ("named rightly, %", "named_right", 100, 1),
        ("realism, mean", "realism_mean", 1, 2),
        ("realism, median", "realism_median", 1, 1),
        ("realism, average median", "realism_average_median", 1, 2),
        ("agreement on names, alpha", "alpha_named", 1, 2),
        ("agreement on realism, alpha", "alpha_realism", 1, 2),
    )
    rows = tuple(
        (what, *(_cell(kinds[kind], key, factor, digits) for kind in kinds)) for what, key, factor, digits in lines
    )
    return ReportTable(f"what {format_count(data['people'], 'person says', 'people say')}", ("what", *kinds), rows)


def _cell(figures: Mapping[str, Any], key: str, factor: float, digits: int) -> str:
    def shown(value: float | None) -> str:
        return "-" if value is None else f"{factor * value:.{digits}f}"

    if figures.get(f"{key}_low") is None:
        return shown(figures[key])
    return f"{shown(figures[key])} ({shown(figures[f'{key}_low'])} to {shown(figures[f'{key}_high'])})"


def _items(data: Mapping[str, Any]) -> ReportTable:
    columns = ("item", "kind", "frame", "truth", "answers", "named rightly, %", "realism, mean", "median")
    keys = (("named_right", 100, 0), ("realism_mean", 1, 2), ("realism_median", 1, 1))
    facts = ("item", "kind", "frame", "truth", "answers")
    rows = tuple((*(str(one[f]) for f in facts), *(_cell(one, *key) for key in keys)) for one in data["items"])
    return ReportTable("picture by picture", columns, rows)
