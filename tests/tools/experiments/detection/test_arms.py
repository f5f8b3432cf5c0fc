"""Which attacks a study compares."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from drivesem.run.run_report import PAPER_COMBOS, PAPER_SINGLE, PROTOCOL, follows_paper
from scene_ir.errors import FormatError
from tools.experiments.detection.arms import (
    PAPER_PROTOCOL,
    PLACEBO,
    RANDOM,
    SEARCH_METHODS,
    STUDY_JSON,
    AttackArm,
    build_arms,
    matching_control,
)
from tools.experiments.settings import StudyConfig

OUT = Path("out")
FRAMES, QUICK_FRAMES = 200, 6
THEIRS: dict[str, Any] = {k: v for k, v in PROTOCOL.items() if k != "early_stop"}
NAMES = ("single", "multi", "samples", "steps", "labels")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("quick", [True, False])
def test_arms_are_attacks_that_the_command_takes(name: str, quick: bool, tmp_path: Path) -> None:
    arms = build_arms(StudyConfig(name=name, quick=quick), tmp_path)
    assert len({arm.folder for arm in arms}) == len(arms)
    for arm in arms:
        if arm.config.like is not None:
            Path(arm.config.like).mkdir(parents=True, exist_ok=True)
        arm.config.check()
        assert arm.config.limit == (QUICK_FRAMES if quick else FRAMES)
    assert arms[0].config.method == "si-fgsm"


@pytest.mark.parametrize("name", NAMES)
def test_the_full_study_goes_on_where_the_quick_one_stopped(name: str) -> None:
    quick, full = ({a.folder: a for a in build_arms(StudyConfig(name=name, quick=q), OUT)} for q in (True, False))
    assert set(quick) <= set(full)
    for folder, arm in quick.items():
        assert replace(arm.config, limit=FRAMES) == full[folder].config


@pytest.mark.parametrize(("name", "count"), [("single", 6), ("multi", 4)])
def test_controls_have_the_same_box_queries_and_size(name: str, count: int) -> None:
    """Ours have random samples and placebos; those of the paper's protocol, which keeps the last, placebos."""
    arms = {arm.name: arm for arm in build_arms(StudyConfig(name=name, steps=7, seeds=2), OUT)}
    longer = name == "multi"
    assert len(arms) == 5 * (count + longer) + 3 * count
    for arm in [a for a in arms.values() if a.control is None]:
        theirs = arm.name.endswith(PAPER_PROTOCOL)
        assert (arm.reference is not None) == theirs
        assert matching_control(arm.config) == (PLACEBO if theirs else RANDOM)
        control_rows = [other for other in arms.values() if other.control_of == arm.name]
        assert [other.config.seed for other in control_rows] == ([0, 1] if theirs else [0, 1, 0, 1])
        for control in control_rows:
            assert (control.config.params, control.config.combo) == (arm.config.params, arm.config.combo)
            assert list(arms).index(control.name) > list(arms).index(arm.name)
            searched = (control.config.method, control.config.range, control.config.queries, control.config.like)
            assert searched in (
                ("random", "steps", arm.config.steps, None),
                ("placebo", "bounds", None, f"out/arms/{arm.folder}"),
            )
            assert control.control == control.config.method
    assert len(build_arms(StudyConfig(name=name, controls=False, paper_protocol=False), OUT)) == count + longer
    first = [arm.folder for arm in build_arms(StudyConfig(name=name, seeds=1), OUT)]
    assert set(first) < {arm.folder for arm in build_arms(StudyConfig(name=name), OUT)}  # three by default


@pytest.mark.parametrize("name", ["single", "multi"])
def test_the_papers_protocol_stands_next_to_where_the_detector_has_its_loss(name: str) -> None:
    def theirs(**settings: Any) -> list[AttackArm]:
        arms = build_arms(StudyConfig(name=name, controls=False, **settings), OUT)
        return [arm for arm in arms if arm.name.endswith(PAPER_PROTOCOL)]

    assert all(follows_paper(arm.config) for arm in theirs(method="apgd", steps=7))
    assert [arm.reference for arm in theirs()] == list(
        (PAPER_COMBOS if name == "multi" else PAPER_SINGLE).values()
    )
    assert len(theirs(detector="yolov3-slim")) == len(theirs())
    assert theirs(detector="module:mine.py") == theirs(paper_protocol=False) == theirs(**THEIRS) == []


def test_the_papers_metrics_stand_next_to_its_own_protocol_only() -> None:
    theirs = THEIRS | {"controls": False, "paper_protocol": False}
    multi = build_arms(StudyConfig(name="multi", **theirs), OUT)  # pyright: ignore[reportArgumentType]
    assert [arm.reference for arm in multi] == [*PAPER_COMBOS.values(), None]  # the last is Auto-PGD's
    single = build_arms(StudyConfig(name="single", **theirs), OUT)  # pyright: ignore[reportArgumentType]
    assert [arm.reference for arm in single] == list(PAPER_SINGLE.values())
    for other in ({"detector": "yolov3-slim"}, {"steps": 7}, {"keep": "best"}, {"budget": "parking"}):
        arms = build_arms(StudyConfig(name="multi", **theirs | other), OUT)  # pyright: ignore[reportArgumentType]
        assert {arm.reference for arm in arms} == {None}


def test_grades_compare_methods_at_the_same_cost() -> None:
    arms = {arm.name: arm for arm in build_arms(StudyConfig(name="grades", steps=7), OUT)}
    assert len(arms) == 15
    for name in ("combo 2", "weather", "all six"):
        gradient, longer, samples = (arms[key].config for key in (name, f"{name}, apgd", f"{name}, halton"))
        assert (gradient.steps, longer.steps, samples.queries) == (7, 28, 21)
        assert gradient.params == longer.params == samples.params
        assert arms[f"{name}, apgd placebo"].control_of == f"{name}, apgd"
    assert all(arm.config.confirm for arm in arms.values())


def test_searches_take_as_many_passes_each() -> None:
    arms = build_arms(StudyConfig(name="searches", passes=40, params="color"), OUT)
    assert [arm.name for arm in arms] == [*SEARCH_METHODS, "climb placebo"]
    assert [arm.config.method for arm in arms] == [*SEARCH_METHODS, "placebo"]
    assert {arm.config.passes for arm in arms[:-1]} == {40}
    assert {(arm.config.params, arm.config.combo) for arm in arms} == {("color", None)}
    assert {arm.config.combo for arm in build_arms(StudyConfig(name="searches"), OUT)} == {2}


def test_searches_take_as_many_seconds_each(tmp_path: Path) -> None:
    """Twice as many passes where a method took half as long as the slowest."""
    rows = [
        {"name": name, "seconds": 10.0 if name == "apgd" else 20.0} for name in (*SEARCH_METHODS, "climb placebo")
    ]
    (tmp_path / STUDY_JSON).write_text(json.dumps({"searches": rows}))
    arms = build_arms(StudyConfig(name="searches", passes=40, pace=str(tmp_path)), OUT)
    passes = {arm.name: arm.config.passes for arm in arms[:-1]}
    assert passes == dict.fromkeys(SEARCH_METHODS, 40) | {"apgd": 80}


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "{}",
        '{"searches": [3]}',
        '{"searches": [{"name": "climb", "seconds": 2.0}]}',
        json.dumps({"searches": [{"name": name, "seconds": 0} for name in SEARCH_METHODS]}),
    ],
)
def test_a_pace_without_seconds_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / STUDY_JSON).write_text(text)
    with pytest.raises(FormatError, match=r"study\.json: searches: expected"):
        build_arms(StudyConfig(name="searches", pace=str(tmp_path)), OUT)
