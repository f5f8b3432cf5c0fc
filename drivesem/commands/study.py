"""`drivesem study`: the paper's experiments, and others, on frames of one's own."""

from __future__ import annotations

from drivesem.config.commands import Study
from drivesem.config.devices import check_device
from drivesem.run.ask import say, show
from tools.experiments.detection.asking import study_run


def run(config: Study) -> int:
    """Run or continue a study, or tell one that was kept; exit code 0. Raises UsageError or SceneError for bad
    input.
    """
    check_device(config.device)
    if config.name == "classification":
        from tools.experiments.classification.asking import study_run as classification_run

        answer = classification_run(config)
    else:
        answer = study_run(config)
    (show if config.kept is not None and config.out is None else say)(answer, config.json)
    return 0
