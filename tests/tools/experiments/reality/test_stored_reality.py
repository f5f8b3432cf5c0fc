"""The stored results of `reality`: which frames they hold, and what was fixed before half B was opened."""

from pathlib import Path

from scene_ir import files
from tools.bench.conditions import DAY, UNDRAWN, half_of
from tools.experiments.reality.observations import (
    ADVERSE,
    DRAWN,
    PLACEBO,
    PLAIN,
    PREDICTED,
    REAL,
    TABLE,
    read_observations,
)
from tools.experiments.reality.rules import fit_stored_rules

STORED = Path(__file__).parents[4] / "docs" / "data" / "reality"


def test_only_half_b_is_reported() -> None:
    rows = read_observations(STORED / TABLE.format("B"))
    assert {half_of(one.frame) for one, _ in rows} == {"B"}
    sources = {(one.source, one.condition) for one, _ in rows}
    assert sources == {(REAL, name) for name in (DAY, *ADVERSE)} | {(PLAIN, UNDRAWN)} | {
        (source, name) for source in (DRAWN, PLACEBO) for name in PREDICTED
    }


def test_rules_follow_from_the_samples_and_were_fixed_first() -> None:
    record = files.read_json(STORED / "study.json")
    settings = record["settings"]
    rules = [rule.to_json() for rule in fit_stored_rules(STORED, settings["rules"], settings["seed"])]
    assert rules == files.read_json(STORED / "rules.json")
    assert record["rules_fixed"] < record["opened_b"]
