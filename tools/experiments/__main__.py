"""Experiments behind the paper's tables: `python -m tools.experiments NAME [options]`, from the repository's root."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

from drivesem.cli import run_program
from drivesem.config.options import CommandConfig
from tools.experiments.settings import (
    PlausibilityConfig,
    RealismConfig,
    StudyConfig,
    SurveyConfig,
    SurveyResultsConfig,
    WorthConfig,
)

STUDIES = (
    *("single", "multi", "grades", "searches", "samples", "steps", "labels", "attribution", "transfer"),
    *("retrain", "classification"),
)
EXPERIMENTS: dict[str, type[CommandConfig]] = {
    **dict.fromkeys(STUDIES, StudyConfig),
    "plausibility": PlausibilityConfig,
    "realism": RealismConfig,
    "worth": WorthConfig,
    "survey": SurveyConfig,
    "survey-results": SurveyResultsConfig,
}
"""Settings of each experiment."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one experiment. Returns the exit code: 0 done, 2 bad input."""
    return run_program(argv, EXPERIMENTS, "python -m tools.experiments", _load_experiment)


def _load_experiment(name: str) -> Callable[[Any], int]:
    experiments: dict[str, Callable[[Any], int]] = {
        "plausibility": _run_plausibility,
        "realism": _run_realism,
        "worth": _run_worth,
        "survey": _run_survey,
        "survey-results": _run_survey_results,
    }
    return experiments.get(name, _run_study)


def _run_study(config: StudyConfig) -> int:
    from drivesem.config.devices import check_device
    from drivesem.run.driver import print_report, publish_report

    check_device(config.device)
    if config.name == "classification":
        from tools.experiments.classification.asking import study_run as run_study
    else:
        from tools.experiments.detection.study import run_study
    report = run_study(config)
    (print_report if config.results is not None and config.out is None else publish_report)(report, config.json)
    return 0


def _run_plausibility(config: PlausibilityConfig) -> int:
    from drivesem.run.driver import publish_report
    from tools.experiments.plausibility.asking import plausibility_run

    publish_report(plausibility_run(config), config.json)
    return 0


def _run_realism(config: RealismConfig) -> int:
    from drivesem.run.driver import publish_report
    from tools.experiments.realism.asking import realism_run

    publish_report(realism_run(config), config.json)
    return 0


def _run_worth(config: WorthConfig) -> int:
    from drivesem.run.driver import publish_report
    from tools.experiments.worth.asking import worth_run

    publish_report(worth_run(config), config.json)
    return 0


def _run_survey(config: SurveyConfig) -> int:
    from drivesem.report.tables import format_count, print_json
    from drivesem.report.terminal import Console
    from drivesem.run.finished import load_runs
    from drivesem.run.folder import resolve_output_folder
    from scene_ir import files
    from tools.experiments.survey.page import (
        CHANGED,
        KEY,
        PAGE,
        UNCHANGED,
        items_of,
        render_page,
        survey_name,
        write_key,
    )

    runs = load_runs(config.runs, setting="RUN")
    out = resolve_output_folder(config.out, runs[0].folder / "survey")
    chosen = items_of(runs, config.items, config.controls, config.seed)
    items = [item for item, _ in chosen]
    page = render_page(chosen)
    files.write_text(out / PAGE, page)
    write_key(out / KEY, items, {"runs": [str(run.folder) for run in runs], "seed": config.seed})
    counts = {kind: sum(item.kind == kind for item in items) for kind in (CHANGED, UNCHANGED)}
    data = {"survey": survey_name(items), "page": str(out / PAGE), "key": str(out / KEY), **counts}
    data["megabytes"] = round(len(page) / 1e6, 2)
    console = Console(stderr=True)
    if config.json:
        print_json(data)
    if counts[CHANGED] < config.items:
        console.print(
            f"only {counts[CHANGED]} of {format_count(config.items, 'picture')}: the runs have no more",
            soft_wrap=True,
        )
    console.print(f"give people {out / PAGE}, keep {out / KEY}", soft_wrap=True, highlight=False)
    return 0


def _run_survey_results(config: SurveyResultsConfig) -> int:
    from drivesem.run.driver import publish_report
    from tools.experiments.survey.results import survey_results

    publish_report(survey_results(config), config.json)
    return 0


if __name__ == "__main__":  # workers load this file too, by another name
    sys.exit(main())
