"""The command line as a user types it: precedence, unknown keys, one line and exit code 2 for bad input."""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

import drivesem
from drivesem.config.commands import COMMANDS, AttackConfig, DriveConfig, ExplainConfig, SynthConfig, TrainConfig
from drivesem.config.constraints import (
    AllowsUrl,
    Constraint,
    ExistingFolder,
    NumberRange,
    OneOf,
    OnlyWith,
    Required,
)
from drivesem.config.errors import UsageError
from drivesem.config.options import CommandConfig, InferenceOptions, find_constraints, option_name, to_yaml
from drivesem.config.parsing import parse
from drivesem.config.presets import preset_commands, preset_words
from drivesem.run.folder import load_attack_config
from tests.drivesem.invoke import invoke
from tools.experiments.__main__ import EXPERIMENTS
from tools.experiments.settings import StudyConfig

ROOT = Path(__file__).parents[3]
CONFIGS = ROOT / "configs"


def test_defaults() -> None:
    assert parse(["attack"]) == AttackConfig()
    assert parse(["synth", "--frames", "3"]) == SynthConfig(frames=3)


def test_command_line_wins_over_preset(tmp_path: Path) -> None:
    preset = tmp_path / "preset.yaml"
    preset.write_text("combo: 3\nsteps: 4\njson: true\nresume: false\n")
    config = parse(["attack", "--steps", "7", "--config", str(preset)])
    assert config == AttackConfig(combo=3, steps=7, json=True, resume=False)


def test_resolved_configuration_reads_back(tmp_path: Path) -> None:
    config = AttackConfig(params="translate,mesh", limit=2, keep_going=True, resume=False, out="a b")
    path = tmp_path / "config.yaml"
    path.write_text("".join(f"{line}\n" for line in to_yaml(config).splitlines() if "null" not in line))
    assert parse(["attack", f"--config={path}"]) == config


def test_words_without_an_option_are_no_settings_of_a_file(tmp_path: Path) -> None:
    """Commands write them into config.yaml with all others: null where there were none."""
    path = tmp_path / "config.yaml"
    path.write_text(to_yaml(DriveConfig(steps=3)))
    assert parse(["drive", "--config", str(path)]) == DriveConfig(steps=3)
    assert parse(["drive", "clips", "--config", str(path)]) == DriveConfig(steps=3, clip="clips")
    path.write_text(to_yaml(DriveConfig(clip="clips")))
    with pytest.raises(UsageError, match=r"config\.yaml: clip: expected no value: .*, found clips"):
        parse(["drive", "--config", str(path)])


_NEEDED: dict[str, tuple[str, ...]] = {
    "classify": ("attack",),
    "explain": ("--run", "run"),
    "confirm": ("--run", "run"),
    "verify": ("--run", "run"),
    "transfer": ("--run", "run", "--detectors", "squeezedet"),
    **dict.fromkeys(("holes", "report"), ("run",)),
    "gate": ("run", "--after", "new.safetensors"),
    **dict.fromkeys(("render", "edit", "view"), ("scene",)),
    "eval": ("--gt", "labels", "--pred", "results"),
    "inspect": ("root",),
    "convert": ("labels", "--to", "coco", "--out", "out"),
    "export": ("--run", "run", "--to", "coco", "--out", "out"),
    "check": ("--detector", "squeezedet"),
    "train": ("--root", "frames"),
    "retrain": ("--run", "run"),
}
"""Words without which a command does not begin."""


@functools.cache
def default_of(name: str) -> CommandConfig:
    """A command's settings with nothing beside what it needs."""
    return parse([name, *_NEEDED.get(name, ())])


@pytest.mark.parametrize("preset", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_presets_parse(preset: Path) -> None:
    names = preset_commands(str(preset))
    assert names
    for name in names:
        by_file = parse([name, "--config", str(preset), *_NEEDED.get(name, ())])
        assert isinstance(by_file, COMMANDS[name])
        for preset_name in (preset.stem, f"configs/{preset.stem}.yaml"):
            assert parse([name, "--config", preset_name, *_NEEDED.get(name, ())]) == by_file


def test_papers_preset_is_for_attacks_and_experiments() -> None:
    theirs = {"objective": "confidence", "objective_labels": "paper", "keep": "last", "project": "bounds"}
    theirs["parametrisation"] = "roi"
    attack = parse(["attack", "--config", str(CONFIGS / "paper.yaml")])
    study = parse(["multi", "--config", str(CONFIGS / "paper.yaml"), "--steps", "3"], EXPERIMENTS)
    assert attack == AttackConfig(combo=2, **theirs)
    assert study == StudyConfig(name="multi", steps=3, **theirs)
    with pytest.raises(UsageError, match=r"paper\.yaml: expected a preset for retrain, found one"):
        preset_words(str(CONFIGS / "paper.yaml"), "retrain", COMMANDS)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("combos: 2\n", "combos: expected one of"),
        ("[1, 2]\n", "expected a mapping"),
        ("combo: [\n", "expected YAML"),
        ("json: 3\n", "json: expected true or false"),
        ("steps: {a: 1}\n", "steps: expected one value"),
        ("for: [attack, drive]\ncombos: 2\n", "combos: expected one of"),
        ("for: [attack, studies]\ncombo: 2\n", "for: expected commands: attack, "),
        ("for: drive\nsteps: 2\n", "expected a preset for attack, found one for drive"),
    ],
)
def test_bad_preset(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(UsageError, match=message) as caught:
        preset_words(str(path), "attack", COMMANDS)
    assert str(path) in str(caught.value)


_TAKE_RUNS = ["verify", "explain", "confirm", "transfer --detectors squeezedet"]


@pytest.mark.parametrize("command", _TAKE_RUNS)
def test_the_run_may_stand_first(command: str) -> None:
    name, *rest = command.split()
    assert parse([name, "runs/a", *rest]) == parse([name, "--run", "runs/a", *rest])


def outside(constraint: Constraint, number: type) -> list[Any]:
    """Values that a constraint does not let through."""
    match constraint:
        case NumberRange(low, high, ends):
            low_values = [low - 1] if ends[0] == "[" else [low - 1, low]
            high_values = [] if high == math.inf else [high + 1] if ends[1] == "]" else [high + 1, high]
            return [number(value) for value in (*low_values, *high_values)] + [math.nan] * (number is float)
        case Required():
            return []
        case OnlyWith() | AllowsUrl():
            return []
        case ExistingFolder() | OneOf():
            return ["nowhere"]
        case _:
            return ["="]


DECLARED = [
    (name, field.name, constraint)
    for name, command in COMMANDS.items()
    for field in dataclasses.fields(command)
    for constraint in find_constraints(command, field.name)
]


@pytest.mark.parametrize(("name", "field", "constraint"), DECLARED)
def test_values_that_a_type_excludes_are_refused(name: str, field: str, constraint: Constraint) -> None:
    config, flag = default_of(name), option_name(field)
    kind = next(f for f in dataclasses.fields(config) if f.name == field)
    number = (
        float if "float" in str(kind.type) or "Fraction" in str(kind.type) or "Score" in str(kind.type) else int
    )
    for value in outside(constraint, number):
        with pytest.raises(UsageError, match=rf"^{flag}: expected .*, found ") as caught:
            dataclasses.replace(config, **{field: value}).check()
        assert "\n" not in str(caught.value)
    if isinstance(constraint, Required):
        with pytest.raises(UsageError, match=f"^{constraint.name or flag}: expected .*, found nothing$"):
            dataclasses.replace(config, **{field: () if field == "runs" else None}).check()
    if isinstance(constraint, OnlyWith):
        changed = {
            "norm": 1,
            "queries": 7,
            "step_form": "raw",
            "half": 1,
            "precision": "bfloat16",
            "dry": True,
            "allow_empty": True,
        }
        value = changed.get(field, 0.5 if kind.type and "float" in str(kind.type) else ".")
        prefix = "" if constraint.field == "what" else "--method "
        unfit = {"classify": ("attack", "si-fgsm"), "runs": ("show", ""), "bench": ("render", "")}
        other = unfit.get(name, ("", "fgsm"))[constraint.field == "method"]
        with pytest.raises(UsageError, match=f"^{flag}: expected only with {prefix}.*, found {prefix}{other}$"):
            dataclasses.replace(config, **{constraint.field: other, field: value}).check()


@pytest.mark.parametrize(
    ("name", "field", "value"),
    [
        (name, field, value)
        for name, field, constraint in DECLARED
        if isinstance(constraint, NumberRange)
        for value in outside(constraint, int)[:1]
    ],
)
def test_a_value_outside_its_range_is_one_line(name: str, field: str, value: int) -> None:
    captured = invoke(name, *_NEEDED.get(name, ()), f"{option_name(field)}={value}", code=2)
    assert captured.out == ""
    assert captured.err.startswith(f"drivesem: {option_name(field)}: expected ")
    assert captured.err.count("\n") == 1


@pytest.mark.parametrize("name", COMMANDS)
def test_defaults_are_settings_and_read_back(name: str, tmp_path: Path) -> None:
    config = default_of(name)
    config.check()
    read = yaml.safe_load(to_yaml(config))
    known = {key: tuple(value) if isinstance(value, list) else value for key, value in read.items()}
    assert COMMANDS[name](**known) == config


_KEYS = {
    "attack": "json out limit seed workers device keep_going resume dataset root combo params detector method "
    "steps queries step_form rate momentum norm like budget range early_stop "
    "objective_labels objective target_objects target_classes fit backend precision t_star tiles",
    "explain": "json out limit seed workers device keep_going resume run frame points permutations bootstrap",
    "confirm": "json out limit seed workers device keep_going resume run root",
    "retrain": "json out limit seed workers device keep_going resume run dataset root start fraction mix "
    "label_mode ramp validation fresh attack_steps steps minutes batch window scale rate warmup "
    "loss precision checkpoint_every",
    "train": "json out limit seed workers device keep_going resume detector dataset root held_out also "
    "frames held_out_frames weights start anchors steps minutes batch window scale optimiser "
    "momentum rate backbone_rate weight_decay warmup warmup_power drops drop_factor clip average "
    "dropout loss precision checkpoint_every evaluate_every thin semantic loaders note",
}
"""Keys of the config.yaml of runs that are there."""


@pytest.mark.parametrize("name", _KEYS)
def test_keys_of_older_runs_are_known(name: str) -> None:
    assert set(_KEYS[name].split()) <= {field.name for field in dataclasses.fields(COMMANDS[name])}


def test_a_run_opens_with_its_keys_in_any_order(tmp_path: Path) -> None:
    config = dataclasses.asdict(AttackConfig(steps=3, t_star=0.4))
    (tmp_path / "config.yaml").write_text(
        yaml.safe_dump({key: config[key] for key in reversed(_KEYS["attack"].split())})
    )
    assert load_attack_config(tmp_path) == AttackConfig(steps=3, t_star=0.4)


def test_version() -> None:
    assert invoke("--version").out == f"drivesem {drivesem.__version__}\n"
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert drivesem.__version__ == declared


def test_help_is_quick() -> None:
    """Of the processor's time: the clock's says how busy the machine is."""
    assert min(_seconds([sys.executable, "-m", "drivesem.cli", "--help"]) for _ in range(3)) < 0.5


def _seconds(words: list[str]) -> float:
    before = os.times()
    finished = subprocess.run(words, capture_output=True, text=True, check=True)
    assert "attack" in finished.stdout
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


@pytest.mark.parametrize(
    ("words", "of_run", "whole"),
    [
        ((), False, False),
        ((), True, True),
        (("--incremental",), True, False),
        (("--incremental",), False, False),
        (("--whole",), False, True),
    ],
)
def test_an_analysis_may_run_detectors_unlike_its_run(words: tuple[str, ...], of_run: bool, whole: bool) -> None:
    config = parse(["explain", "--run", "run", *words])
    assert isinstance(config, ExplainConfig)
    assert config.resolve_whole(of_run) is whole


@pytest.mark.parametrize("command", [("attack",), ("bench",), ("explain", "--run", "run")])
def test_incremental_and_whole_exclude_each_other(command: tuple[str, ...]) -> None:
    parse([*command, "--incremental"])
    with pytest.raises(
        UsageError, match="--incremental: expected only one of --incremental and --whole, found both"
    ):
        parse([*command, "--incremental", "--whole"])


@pytest.mark.parametrize("command", [("attack",), ("bench",), ("explain", "--run", "run")])
def test_memory_of_layers(command: tuple[str, ...]) -> None:
    configs = [parse([*command, *words]) for words in ((), ("--keep-mb", "50"))]
    assert [config.keep_mb for config in configs if isinstance(config, InferenceOptions)] == [800, 50]
    with pytest.raises(UsageError, match="--keep-mb: expected at least 1, found 0"):
        parse([*command, "--keep-mb", "0"])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"steps": "3"}, "--steps: expected a whole number, found '3'"),
        ({"steps": True}, "--steps: expected a whole number, found True"),
        ({"rate": "fast"}, "--rate: expected a number, found 'fast'"),
        ({"method": "climbs"}, "--method: expected one of si-fgsm, apgd"),
        ({"confirm": 1}, "--confirm: expected true or false, found 1"),
        ({"params": 3}, "--params: expected text, found 3"),
    ],
)
def test_settings_made_in_python_are_checked_too(values: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError) as caught:
        AttackConfig(**values).check()
    assert str(caught.value).startswith(message)
    AttackConfig(rate=1, limit=None, params="mesh").check()


def test_anchors_may_be_a_number() -> None:
    assert [parse(["train", "--root", "a", *words]) for words in ([], ["--anchors", "5"])] == [
        TrainConfig(root="a"),
        TrainConfig(root="a", anchors=5),
    ]


def test_a_command_of_tools_knows_its_name() -> None:
    assert parse(["single", "--quick"], EXPERIMENTS) == StudyConfig(name="single", quick=True)
