"""Which runs keep to the paper's protocol."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from drivesem.attacks.budgets import format_budget, parse_budget
from drivesem.config.commands import AttackConfig
from drivesem.config.parsing import parse
from drivesem.run.run_report import PROTOCOL, follows_paper

PRESET = Path(__file__).parents[3] / "configs" / "paper.yaml"


def test_the_preset_is_the_protocol() -> None:
    preset = yaml.safe_load(PRESET.read_text())
    assert {name: value for name, value in preset.items() if name not in ("for", "combo", "budget")} == PROTOCOL
    config = parse(["attack", "--config", str(PRESET)])
    assert isinstance(config, AttackConfig)
    assert follows_paper(config)
    # as a finished run's config.yaml has it, and for other parameters and data
    other = replace(
        config, budget=format_budget(parse_budget("paper")), combo=None, params="mesh", limit=3, draws=20, seed=5
    )
    assert follows_paper(other)


@pytest.mark.parametrize(
    "changed",
    [
        {"method": "apgd"},
        {"detector": "yolov3-slim"},
        {"steps": 40},
        {"early_stop": True},
        {"objective": "objectness"},
        {"objective_labels": "moved"},
        {"keep": "best"},
        {"project": "feasible"},
        {"budget": "parking"},
        {"rate": 0.5},
        {"momentum": 0.5},
        {"passes": 300},
    ],
)
def test_any_other_setting_is_another_protocol(changed: dict[str, object]) -> None:
    theirs = AttackConfig(**PROTOCOL)  # pyright: ignore[reportArgumentType]
    assert follows_paper(theirs)
    assert not follows_paper(replace(theirs, **changed))  # pyright: ignore[reportArgumentType]
    assert not follows_paper(AttackConfig())
