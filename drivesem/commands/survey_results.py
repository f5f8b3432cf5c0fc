"""`drivesem survey-results`: what people said of the survey's pictures."""

from __future__ import annotations

from drivesem.config.commands import SurveyResults
from drivesem.run.ask import say
from tools.experiments.survey.results import survey_results


def run(config: SurveyResults) -> int:
    """Measure, print; exit code 0. Raises UsageError or SceneError for bad input."""
    say(survey_results(config), config.json)
    return 0
