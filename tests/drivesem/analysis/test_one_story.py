"""One failure, one story: all commands agree in its object, grade and counts."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from drivesem.analysis import gate
from drivesem.failures.grades import AGREEMENT_RULE, Grade
from drivesem.failures.kinds import OBJECT_KINDS
from drivesem.run import attack as run_attack
from drivesem.run import detection_cache
from drivesem.run import folder as run_folder
from drivesem.run.finished import load_run
from drivesem.run.frame import certain_losses, has_grade
from drivesem.run.results import Failure
from tests.drivesem.invoke import run_json
from tests.drivesem.timid import Timid

pytestmark = pytest.mark.slow

is_certain = has_grade(Grade.CERTAIN)


@dataclass(frozen=True)
class Story:
    """A finished run of one detector, and the JSON of every command on it."""

    run: Path
    answers: dict[str, Any]
    """By command."""

    @property
    def failures(self) -> list[tuple[str, Failure]]:
        """Failures of a kind, each with its frame."""
        frames = [frame.result for frame in load_run(self.run).frames]
        return [(one.identifier, failure) for one in frames for failure in one.failures if failure.error]

    def rows(self, command: str, key: str = "failures") -> list[dict[str, Any]]:
        """The rows of a command, one per failure."""
        return self.answers[command][key]


def run_commands(run: Path, detectors: str = "any") -> Story:
    """Run all commands on a finished run."""
    one = ("--workers", "1", "--run", run)
    empty = int(not any(certain_losses(frame.result) for frame in load_run(run).frames))  # nothing to compare
    return Story(
        run,
        {
            "attack": json.loads((run / "metrics.json").read_text()),
            "confirm": run_json("confirm", *one),
            "explain": run_json("explain", *one, "--points", "2", "--permutations", "2"),
            "holes": run_json(
                "holes", run, "--workers", "1", "--samples", "24", "--fresh", "1", "--contrast", "0"
            ),
            "transfer": run_json("transfer", *one, "--detectors", detectors),
            "gate": run_json("gate", run, "--workers", "1", "--samples", "2", "--after", detectors, code=empty),
            "report": run_json("report", run, "--out", run / "page.html"),
        },
    )


def contradictions(story: Story) -> list[str]:
    """Follow each graded failure through all answers, and list what does not agree."""
    found = []

    def check(agrees: bool, what: str) -> None:
        found.extend([] if agrees else [what])

    grades, kinds = story.answers["attack"]["grades"], story.answers["attack"]["kinds"]
    for grade in Grade:
        if grade is not Grade.THRESHOLD:
            check(grades[grade] == sum(has_grade(grade)(f) for _, f in story.failures), f"attack: {grade}")
    for kind, count in kinds.items():
        check(count == sum(f.error == kind for _, f in story.failures), f"attack: {kind}")
    lost = [failure for _, failure in story.failures if failure.error in OBJECT_KINDS and is_certain(failure)]
    check(story.answers["gate"]["failures"] == len(lost), "gate: certain failures of objects")
    (reported,) = story.rows("report", "runs")
    for key in ("grades", "kinds", "objects", "missed_before", "frames", "frames_not_attacked"):
        check(reported.get(key) == story.answers["attack"].get(key), f"report: {key}")
    holes = [one for hole in story.rows("holes", "holes") for one in hole["failures"]]
    for frame, failure in story.failures:
        same = {"frame": frame, "object": failure.index, "kind": failure.error, "grade": failure.grade}
        name = f"{frame}, {failure.error}, object {failure.index}"

        def answers(rows: list[dict[str, Any]], same: dict[str, Any] = same) -> list[dict[str, Any]]:
            return [row for row in rows if same.items() <= row.items()]

        check(len(answers(story.rows("confirm"))) == 1, f"confirm: {name}")
        for row in answers(story.rows("confirm")):
            second = row["second"]
            survives = min(second["before"], second["after"]) >= AGREEMENT_RULE[0]
            check(row["survives"] is survives, f"confirm: survives, {name}")
            if failure.second is not None:
                counts = (failure.second.before, failure.second.after, failure.second.draws)
                check((second["before"], second["after"], second["draws"]) == counts, f"confirm: draws, {name}")
                check(row["survives"] is has_grade(Grade.CONFIRMED)(failure), f"confirm: grade, {name}")
        check(len(answers(story.rows("explain", "rows"))) == 1, f"explain: {name}")
        for row in answers(story.rows("explain", "rows")):
            least = row["least"]
            check(0 <= least["draws"] <= least["of"], f"explain: draws, {name}")
            check(least["holds"] is (4 * least["draws"] >= 3 * least["of"] > 0), f"explain: holds, {name}")
            check(least["holds"] or not is_certain(failure), f"explain: a certain failure is kept, {name}")
        is_object = failure.error in OBJECT_KINDS
        check(len(answers(holes)) == (is_object and is_certain(failure)), f"holes: {name}")
        check(len(answers(story.rows("transfer"))) == (failure.kind == "lost"), f"transfer: {name}")
        for row in answers(story.rows("transfer")):
            # before the run's own detector, in the run's own picture, everything is as in the run
            check(row["found"] and row["lost"], f"transfer: own detector, {name}")
    return found


@pytest.fixture(scope="module")
def story(tmp_path_factory: pytest.TempPathFactory) -> Story:
    """An embedded run with a failure of each kind, all certain."""
    out, timid = tmp_path_factory.mktemp("story") / "run", Timid()
    with pytest.MonkeyPatch.context() as patch:
        for module in (run_attack, run_folder, detection_cache, gate):
            patch.setattr(module, "load_predictor", lambda *_: timid)
        words = [
            "--detector",
            "any",
            "--limit",
            "1",
            "--workers",
            "1",
            "--params",
            "weather",
            "--method",
            "random",
        ]
        words += ["--queries", "2", "--nuisances", "off", "--budget", "weather=0.2", "--second-detector", "off"]
        run_json("attack", *words, "--out", out)
        return run_commands(out)


def test_there_is_a_story(story: Story) -> None:
    assert {failure.error for _, failure in story.failures} == {"missed", "class", "placed", "twice", "background"}
    assert all(map(is_certain, (failure for _, failure in story.failures)))


def test_all_commands_agree(story: Story) -> None:
    assert contradictions(story) == []


@pytest.mark.parametrize(
    ("command", "key", "change"),
    [
        ("confirm", "failures", {"survives": False}),
        ("explain", "rows", {"object": 77}),
        ("explain", "rows", {"least": {"holds": False, "draws": 0, "of": 4}}),
        ("transfer", "failures", {"grade": "threshold"}),
    ],
)
def test_a_contradiction_is_found(story: Story, command: str, key: str, change: dict[str, Any]) -> None:
    answer = story.answers[command]
    spoilt = {**answer, key: [{**answer[key][0], **change}, *answer[key][1:]]}
    assert contradictions(Story(story.run, {**story.answers, command: spoilt}))
