"""Experiments behind the paper's tables: `python -m tools.experiments NAME [options]`, from the repository's root."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from typing import Any

from drivesem import __version__
from drivesem.config.options import CommandConfig
from drivesem.program import Program
from tools.experiments.settings import (
    FidelityConfig,
    PlausibilityConfig,
    RealismConfig,
    RealityConfig,
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
    "fidelity": FidelityConfig,
    "reality": RealityConfig,
    "worth": WorthConfig,
    "survey": SurveyConfig,
    "survey-results": SurveyResultsConfig,
}
"""Settings of each experiment."""
_RUNNERS = {
    **dict.fromkeys(STUDIES, "detection.study:run_study"),
    "classification": "classification.study:run_classification_study",
    "plausibility": "plausibility.percentiles:run_plausibility",
    "realism": "realism.report:run_realism",
    "fidelity": "fidelity:run_fidelity",
    "reality": "reality.run:run_reality",
    "worth": "worth.run:run_worth",
    "survey": "survey.page:run_survey",
    "survey-results": "survey.results:run_survey_results",
}
"""The function of each experiment, which gives a report or an exit code."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one experiment. Returns the exit code: 0 done, 2 bad input."""
    summary = "Experiments behind the paper's tables."
    return Program("python -m tools.experiments", __version__, summary, EXPERIMENTS, _load_experiment).main(argv)


def _load_experiment(name: str) -> Callable[[Any], int]:
    module, _, function = _RUNNERS[name].partition(":")

    def run(config: Any) -> int:
        from drivesem.config.devices import check_device
        from drivesem.run.driver import print_report, publish_report

        if isinstance(config, StudyConfig):
            check_device(config.device)
        report = getattr(importlib.import_module(f"tools.experiments.{module}"), function)(config)
        if isinstance(report, int):
            return report
        unwritten = isinstance(config, StudyConfig) and config.results is not None and config.out is None
        (print_report if unwritten else publish_report)(report, config.json)
        return 0

    return run


if __name__ == "__main__":  # workers load this file too, by another name
    sys.exit(main())
