"""The results of a survey: share of vehicles named correctly, realism, and agreement between people."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.config.errors import UsageError
from drivesem.evaluation.instances import Floats
from drivesem.evaluation.resampling import DRAWS, Interval, NamedMetric, bootstrap_intervals
from drivesem.reporting.tables import AnalysisReport, ReportTable, format_count
from drivesem.run.folder import resolve_output_folder
from tools.experiments.settings import SurveyResultsConfig
from tools.experiments.survey.page import KEY, KINDS, SurveyItem, SurveyResponse, read_answers, read_key

_TEXT_COLUMNS = ("metric", "item", "kind", "frame", "truth")
_PAPER = {
    "named_right": 0.98,
    "realism_mean": {"classification": 6.35, "detection": 4.74},
    "realism_average_median": {"classification": 6.67, "detection": 4.26},
}
"""Section 4.2 and appendix of the paper: 30 people, 15 counterexamples each."""
_NOTE = (
    "Intervals: 95 % of the bootstrap over people. Average median: mean over pictures of the median over people, as "
    "in the paper. Alpha: Krippendorff's, 1 if all agree, 0 as by chance. The paper: 98 % named correctly; realism "
    "6.35, average median 6.67 (classification, rendered meshes), 4.74 and 4.26 (detection)."
)


def run_survey_results(config: SurveyResultsConfig) -> AnalysisReport:
    """Read answers, and write the results. Raises UsageError or FormatError for bad input."""
    place = Path(config.survey or "")
    key = place / KEY if place.is_dir() else place
    name, items = read_key(key)
    answers: list[SurveyResponse] = []
    for path in config.answers:
        more = read_answers(Path(path), name, items)
        known = {(answer.participant, answer.item) for answer in answers}
        for answer in more:
            if (answer.participant, answer.item) in known:
                raise UsageError(path, "people who answered once", f"{answer.participant} again")
        answers += more
    if not answers:
        raise UsageError("ANSWERS", "files with answers", "none in them")
    draws = DRAWS if config.bootstrap is None else config.bootstrap
    summary = summarise_responses(items, answers, draws, config.seed)
    data: dict[str, Any] = {"survey": name, "bootstrap": draws, **summary, "paper": _PAPER}
    metrics = _metric_table(data)
    report = AnalysisReport(
        out=resolve_output_folder(config.out, key.parent / "results"),
        name="survey",
        heading="Survey",
        data=data,
        csv_tables={"survey": data["items"]},
        tables=[metrics, _item_table(data)],
        printed_tables=[metrics],
        notes=[_NOTE],
        text_columns=_TEXT_COLUMNS,
        json_only=True,
    )
    report.write()
    return report


def _metric_table(data: Mapping[str, Any]) -> ReportTable:
    kinds = data["kinds"]
    lines = (
        ("pictures", "items", 1, 0),
        ("answers", "answers", 1, 0),
        ("people", "people", 1, 0),
        ("named correctly, %", "named_right", 100, 1),
        ("realism, mean", "realism_mean", 1, 2),
        ("realism, median", "realism_median", 1, 1),
        ("realism, average median", "realism_average_median", 1, 2),
        ("agreement on names, alpha", "alpha_named", 1, 2),
        ("agreement on realism, alpha", "alpha_realism", 1, 2),
    )
    rows = tuple(
        (name, *(_format_cell(kinds[kind], key, factor, digits) for kind in kinds))
        for name, key, factor, digits in lines
    )
    return ReportTable(f"answers of {format_count(data['people'], 'person', 'people')}", ("metric", *kinds), rows)


def _format_cell(row: Mapping[str, Any], key: str, factor: float, digits: int) -> str:
    value, low, high = (
        "-" if number is None else f"{factor * number:.{digits}f}"
        for number in (row[key], row.get(f"{key}_low"), row.get(f"{key}_high"))
    )
    return value if row.get(f"{key}_low") is None else f"{value} ({low} to {high})"


def _item_table(data: Mapping[str, Any]) -> ReportTable:
    columns = ("item", "kind", "frame", "truth", "answers", "named correctly, %", "realism, mean", "median")
    keys = (("named_right", 100, 0), ("realism_mean", 1, 2), ("realism_median", 1, 1))
    rows = tuple(
        (*(str(one[name]) for name in columns[:5]), *(_format_cell(one, *key) for key in keys))
        for one in data["items"]
    )
    return ReportTable("by picture", columns, rows)


@dataclass(frozen=True, slots=True)
class ResponseMean:
    """Mean of answers that can be reweighted by person."""

    values: Floats
    """Values (N,)."""
    person: np.ndarray
    """Index of the person (N,)."""

    def value(self, weights: Floats | None) -> float | None:
        counts = np.ones(len(self.values)) if weights is None else weights[self.person]
        return float(counts @ self.values / counts.sum()) if counts.sum() > 0 else None


def summarise_responses(
    items: Sequence[SurveyItem], answers: Sequence[SurveyResponse], draws: int, seed: int
) -> dict[str, Any]:
    """Summarise answers as JSON: by kind of question, and question by question.

    Args:
        items: The questions.
        answers: All answers.
        draws: Bootstrap draws of people.
        seed: Seed of the draws.

    Returns:
        For each kind the share named correctly, mean realism, the mean of the questions' medians (the paper's
        average median) and agreement; and each question.
    """
    people = sorted({answer.participant for answer in answers})
    kinds = {}
    for kind in KINDS:
        chosen = {item.item: item for item in items if item.kind == kind}
        given = [answer for answer in answers if answer.item in chosen]
        if not given:
            continue
        person = np.array([people.index(answer.participant) for answer in given])
        right = np.array([answer.named == chosen[answer.item].truth for answer in given], np.float64)
        ratings = np.array([answer.realism for answer in given], np.float64)
        by_item = [[a for a in given if a.item == name] for name in chosen]
        medians = [float(np.median([a.realism for a in group])) for group in by_item if group]
        named, real = (_interval(values, person, len(people), draws, seed) for values in (right, ratings))
        kinds[kind] = {
            "items": len(chosen),
            "answers": len(given),
            "people": len(set(person.tolist())),
            "named_right": named.value,
            "named_right_low": named.low,
            "named_right_high": named.high,
            "realism_mean": real.value,
            "realism_mean_low": real.low,
            "realism_mean_high": real.high,
            "realism_median": float(np.median(ratings)),
            "realism_average_median": float(np.mean(medians)),
            "alpha_named": krippendorff_alpha([[a.named for a in group] for group in by_item], nominal_distance),
            "alpha_realism": krippendorff_alpha(
                [[a.realism for a in group] for group in by_item], interval_distance
            ),
        }
    return {
        "people": len(people),
        "answers": len(answers),
        "kinds": kinds,
        "items": _summarise_items(items, answers),
    }


def _interval(values: Floats, person: np.ndarray, people: int, draws: int, seed: int) -> Interval:
    metric = NamedMetric("", (ResponseMean(values, person),))  # pyright: ignore[reportArgumentType]
    (one,) = bootstrap_intervals([metric], people, draws, np.random.default_rng(seed))
    return one


def _summarise_items(items: Sequence[SurveyItem], answers: Sequence[SurveyResponse]) -> list[dict[str, Any]]:
    rows = []
    for item in items:
        given = [answer for answer in answers if answer.item == item.item]
        ratings = [answer.realism for answer in given]
        rows.append(
            {
                **asdict(item),
                "answers": len(given),
                "named_right": sum(a.named == item.truth for a in given) / len(given) if given else None,
                "realism_mean": float(np.mean(ratings)) if given else None,
                "realism_median": float(np.median(ratings)) if given else None,
            }
        )
    return rows


def krippendorff_alpha(
    items: Sequence[Sequence[Any]], squared_distance: Callable[[Any, Any], float]
) -> float | None:
    """Krippendorff's alpha of the answers to each item (Content Analysis, ch. 11).

    alpha = 1 - D_o / D_e: the disagreement within items over that of values dealt at random. 1: all agree; 0: as by
    chance; below 0: worse. People may skip items. None if no item has two answers, or all answers are equal.
    `squared_distance` is that of two answers, such as `nominal_distance` or `interval_distance`.
    """
    pairable = [list(answers) for answers in items if len(answers) >= 2]
    everything = [answer for answers in pairable for answer in answers]
    count = len(everything)
    if not count:
        return None
    within = sum(_sum_pairs(answers, squared_distance) / (len(answers) - 1) for answers in pairable) / count
    expected = _sum_pairs(everything, squared_distance) / (count * (count - 1))
    return None if expected == 0 else 1 - within / expected


def nominal_distance(first: Hashable, second: Hashable) -> float:
    """Squared distance of names: 1 if they differ."""
    return float(first != second)


def interval_distance(first: float, second: float) -> float:
    """Squared distance of numbers on an even scale."""
    return float(first - second) ** 2


def _sum_pairs(answers: Sequence[Any], squared_distance: Callable[[Any, Any], float]) -> float:
    """Sum over ordered pairs of answers; equal values are counted together."""
    values = list(dict.fromkeys(answers))
    times = np.array([answers.count(value) for value in values], np.float64)
    distances = np.array([[squared_distance(a, b) for b in values] for a in values])
    return float(times @ distances @ times)
