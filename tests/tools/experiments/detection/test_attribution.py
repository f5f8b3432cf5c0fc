"""Points of each factor of the protocol."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import pytest

from drivesem.config.commands import AttackConfig
from drivesem.run.run_report import follows_paper
from tests.tools.experiments.detection.conftest import counted, frame
from tools.experiments.detection.arms import PAPER_PROTOCOL
from tools.experiments.detection.attribution import (
    COUNTED_LABELS,
    OURS,
    Attribution,
    AttributionPlan,
    attribute_drop,
    attribution_report,
    write_waterfall,
)
from tools.experiments.detection.counts import StudyCounts
from tools.experiments.settings import StudyConfig

FRAMES, DRAWS = 6, 10


def plan_of(**settings: Any) -> AttributionPlan:
    study = StudyConfig(name="attribution", **settings)
    return AttributionPlan.from_study(study)


@pytest.mark.parametrize(("other", "count"), [(None, 13), ("yolov3-slim", 16)])
def test_each_attack_is_an_arm_once(other: str | None, count: int, tmp_path: Path) -> None:
    plan = plan_of(other_detector=other)
    arms = plan.arms()
    assert len({arm.name for arm in arms}) == len({arm.folder for arm in arms}) == len(arms) == count
    assert len({str(arm.config) for arm in arms}) == count
    for arm in arms:
        arm.config.check()
        assert not arm.config.grade
    named = {arm.name: arm.config for arm in arms}
    default = AttackConfig(combo=2, limit=200, grade=False)
    assert named[OURS] == default
    assert follows_paper(named[PAPER_PROTOCOL]) == (other is None)
    assert named[PAPER_PROTOCOL].detector == (other or default.detector)


def test_a_way_changes_one_factor_at_a_time_and_the_factors_start_as_ours() -> None:
    plan = plan_of(objective="total", keep="last", parametrisation="roi", other_detector="other")
    assert plan.config(frozenset()) == plan_of().config(frozenset())
    for way in plan.paths():
        assert (way[0], way[-1]) == (frozenset(), {*plan.factors})
        for one, other in pairwise(way):
            (factor,) = other - one
            changed = [k for k, v in vars(plan.config(one)).items() if v != vars(plan.config(other))[k]]
            assert len(changed) == (factor != COUNTED_LABELS)
    assert plan.paths()[1] != plan.paths()[0]


@pytest.fixture
def found() -> Attribution:
    """Labels that are aimed at lose a car in two frames of six; what is not projected drives it away in all."""
    plan, runs = plan_of(limit=FRAMES), []
    for arm in plan.arms():
        lost = 2 if arm.config.objective_labels == "paper" else 0
        by = 40.0 if arm.config.project == "bounds" else 0.0
        runs.append(counted(arm, [frame(f"{i}", moved_by=by, found=i >= lost) for i in range(FRAMES)]))
    counts = StudyCounts(tuple(runs), 1, {"000009": "no camera"})
    return attribute_drop(StudyConfig(name="attribution", bootstrap=DRAWS), counts)


def test_points_sum_to_the_difference_on_both_paths_and_in_the_mean(found: Attribution) -> None:
    assert found.ours == 0
    difference = found.papers - found.ours
    assert difference > 0.4
    assert sum(share.points.value for share in found.shares[:-2]) == pytest.approx(difference, abs=1e-12)
    assert found.shares[-1].points.value == pytest.approx(difference, abs=1e-12)
    for way in range(2):
        assert sum(share.path_points[way] for share in found.shares[:-2]) == pytest.approx(difference, abs=1e-12)
    both = sum(share.points.value for share in found.shares[:2])
    assert found.shares[-2].points.value == pytest.approx(both, abs=1e-12)
    for share in found.shares:
        assert share.points.value == pytest.approx(sum(share.path_points) / 2, abs=1e-12)
        assert share.points.low <= share.points.value <= share.points.high


def test_points_are_of_the_factors_that_did_it(found: Attribution) -> None:
    shares = {share.name: share for share in found.shares}
    for name in ("loss", "final iterate", "parametrisation"):
        assert (shares[name].points.value, shares[name].points.low, shares[name].p) == (0, 0, 1)
    # by labels that move a car that drove away is found; by labels that stay it is lost, and a false one beside
    assert shares["projection"].path_points[1] == 0 < shares["projection"].path_points[0]
    assert shares[COUNTED_LABELS].path_points[0] == 0 < shares[COUNTED_LABELS].path_points[1]
    assert shares["projection"].alone.value == 0
    # ten of twelve cars are found, nothing else: precision is 1 up to a recall of 10 / 12
    assert shares["labels aimed at"].alone.value == pytest.approx(1 - 84 / 101)
    assert 0 < shares["labels aimed at"].p <= 1


def test_text_json_and_picture(found: Attribution, tmp_path: Path) -> None:
    report = attribution_report(found, tmp_path)
    first = report.tables[0]
    assert [row[0] for row in first.rows] == [share.name for share in found.shares]
    assert first.rows[-2][0] == "labels, both"
    assert first.title.endswith(f"from 0.00, ours, to {100 * found.papers:.2f}, the paper's protocol")
    data = found.to_json()
    assert (data["frames"], data["papers"], len(data["arms"])) == (FRAMES, found.papers, 13)
    assert data["rows"][0]["name"] == COUNTED_LABELS
    assert data["rows"][0]["points_low"] <= data["rows"][0]["points"]
    assert any("000009" in note for note in report.notes)
    write_waterfall(tmp_path / "a.png", found)
    picture = cv2.imread(str(tmp_path / "a.png"))
    assert picture is not None
    assert picture.std() > 10
