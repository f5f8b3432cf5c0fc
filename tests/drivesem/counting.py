"""What a run of `drivesem attack` would count, of results made by hand."""

from collections.abc import Sequence

from detectors.types import CLASSES
from drivesem.attacks.targets import HEADLINE
from drivesem.config.commands import AttackConfig
from drivesem.evaluation import coco
from drivesem.run.frame import (
    build_map,
    count_grades,
    count_objects,
    detections_from_records,
    targets_from_records,
)
from drivesem.run.results import FrameResult, RunSummary

T_STAR = 0.5


def summary_of(config: AttackConfig, results: Sequence[FrameResult]) -> RunSummary:
    """As `drivesem attack` counts."""

    def scores(labels: str, seen: str) -> coco.CocoScores:
        targets = [targets_from_records(getattr(r, f"targets_{labels}"), CLASSES) for r in results]
        found = [detections_from_records(getattr(r, f"detections_{seen}"), CLASSES) for r in results]
        return coco.evaluate(targets, found, CLASSES, T_STAR, HEADLINE)

    def count(kind: str) -> dict[str, int]:
        return {
            name: sum(f.kind == kind for r in results for f in r.failures) * (name == HEADLINE) for name in CLASSES
        }

    return RunSummary(
        out="",
        dataset=config.dataset,
        params=("translate", "rotate", "mesh"),
        detector=config.detector,
        headline=HEADLINE,
        t_star=T_STAR,
        frames=len(results),
        frames_without_vehicles=0,
        frames_failed={},
        frames_not_attacked={r.identifier: r.reason_not_attacked for r in results if not r.attacked},
        **count_objects(results),
        benign=scores("benign", "benign"),
        rerendered=scores("benign", "rerendered"),
        attacked_paper=scores("benign", "attacked"),
        attacked_moved=scores("moved", "attacked"),
        lost_objects=count("lost"),
        phantoms=count("phantom"),
        successes_paper=sum(r.success_paper for r in results),
        successes_moved=sum(r.success_moved for r in results),
        feasible_fraction=1.0,
        queries=sum(r.queries for r in results),
        map=build_map(results),
        **count_grades(results),
        seconds=0.0,
    )
