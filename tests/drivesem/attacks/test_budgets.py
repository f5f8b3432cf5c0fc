"""Budgets as text, and the bounds of theta that follow."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from drivesem.attacks.budgets import PRESETS, budget_for_coordinates, change_limits, format_budget, parse_budget
from drivesem.attacks.feasibility_check import check_scene
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.space import PAPER_PARAMETERS, Budget, Parameter, ParameterSpace
from drivesem.config.errors import UsageError
from scene_ir.errors import FormatError, RangeError


def test_presets():
    assert parse_budget("paper") == Budget()
    parking = parse_budget("parking")
    assert parking == Budget(translate_m=0.5, rotate=math.radians(5))


def test_a_file_narrows_the_papers_budget(tmp_path: Path):
    path = tmp_path / "own.yaml"
    path.write_text("translate: 0.1\nrotate: 5deg\nmesh: 0.05\n")
    assert parse_budget(str(path)) == Budget(translate=0.1, rotate=math.radians(5), mesh=0.05)
    path.write_text("translate: 0.3m\nrotate: 0.2\n")
    assert parse_budget(str(path)) == Budget(translate_m=0.3, rotate=0.2)
    path.write_text("# nothing\n")
    assert parse_budget(str(path)) == Budget()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rotates: 5deg\n", "own.yaml: rotates: expected one of color, weather, foliage, translate, rotate, mesh"),
        ("rotate: 5\n", "own.yaml: rotate: expected a positive number of at most 0.35, found 5"),
        ("rotate: 5m\n", "own.yaml: rotate: expected a finite number, found '5m'"),
        ("rotate: '0.1'\n", "own.yaml: rotate: expected a unit: 0.1deg or 0.1rad, found '0.1'"),
        ("translate: 0\n", "own.yaml: translate: expected a positive number of at most 0.25, found 0"),
        ("translate: -0.5m\n", "own.yaml: translate: expected a positive number, found -0.5m"),
        ("mesh: true\n", "own.yaml: mesh: expected a finite number, found True"),
        ("weather: .nan\n", "own.yaml: weather: expected a finite number, found nan"),
        ("color: [0.1]\n", r"own.yaml: color: expected a finite number, found \[0.1\]"),
        ("- rotate\n", "own.yaml: expected a mapping, found list"),
        ("rotate: [\n", "own.yaml: expected YAML"),
    ],
)
def test_a_bad_file_is_one_line(tmp_path: Path, text: str, message: str):
    path = tmp_path / "own.yaml"
    path.write_text(text)
    with pytest.raises(FormatError, match=message) as caught:
        parse_budget(str(path))
    assert "\n" not in str(caught.value)


def test_invalid_budgets_are_named(tmp_path: Path):
    with pytest.raises(UsageError, match="--budget: expected paper, parking, street, a YAML file, or NAME=VALUE"):
        parse_budget("generous")
    with pytest.raises(FormatError, match=r"nowhere\.yaml: expected a readable file"):
        parse_budget(str(tmp_path / "nowhere.yaml"))
    with pytest.raises(UsageError, match=r"--budget: expected paper, parking, street, .*found 'street,'"):
        parse_budget("street,")
    with pytest.raises(FormatError, match="--budget: rotate: expected each parameter once"):
        parse_budget("rotate=5deg,rotate=6deg")


def test_a_preset_can_be_narrowed_and_not_widened():
    assert parse_budget("street,translate=2m,rotate=5deg") == replace(
        PRESETS["street"], translate_m=2.0, rotate=math.radians(5)
    )
    assert parse_budget("street,translate=0.1") == replace(PRESETS["street"], translate=0.1, walk_m=0)
    assert parse_budget("parking,rotate=2deg") == replace(PRESETS["parking"], rotate=math.radians(2))
    for text in ("street,translate=50m", "street,translate=50", "parking,translate=0.6m", "street,rotate=0.36"):
        with pytest.raises(FormatError, match=r"--budget: .*: expected a positive number of at most"):
            parse_budget(text)


def test_sizes_and_the_sun_change_in_street_alone():
    assert parse_budget("street").size == 0.1
    assert parse_budget("paper").size == parse_budget("parking").size == 0
    assert (parse_budget("street").sun, parse_budget("paper").sun) == (1, 0)
    assert parse_budget("street,sun=0.5") == replace(PRESETS["street"], sun=0.5)
    with pytest.raises(FormatError, match=r"--budget: sun: expected street,sun=0.5, since only street lets it"):
        parse_budget("sun=0.5")
    narrowed = parse_budget("street,size=5%")
    assert narrowed == replace(PRESETS["street"], size=0.05) == parse_budget(format_budget(narrowed))
    assert format_budget(narrowed) == "street,size=0.05"
    with pytest.raises(FormatError, match=r"--budget: size: expected street,size=5%, since only street lets it"):
        parse_budget("size=5%")
    with pytest.raises(FormatError, match=r"--budget: size: expected a positive number of at most 0.1, found 20%"):
        parse_budget("street,size=20%")


@given(
    preset=st.sampled_from(list(PRESETS)),
    shares=st.dictionaries(st.sampled_from(list(Parameter)), st.floats(1e-6, 1)),
    metres=st.none() | st.floats(1e-6, 0.5),
)
def test_a_formatted_budget_parses_back(preset: str, shares: dict[Parameter, float], metres: float | None) -> None:
    """Every preset, narrowed in all possible ways; `shares` are shares of its limits."""
    widest = PRESETS[preset]
    limits = {p.value: repr(share * getattr(widest, p.value)) for p, share in shares.items()}
    if metres is not None:
        limits["translate"] = f"{metres!r}m"
    narrowed = [f"{name}={limit}" for name, limit in limits.items() if float(limit.rstrip("m"))]
    budget = parse_budget(",".join([preset, *narrowed]) if narrowed else preset)
    assert parse_budget(format_budget(budget)) == budget


def test_own_lengths_and_parkings_metres_are_written() -> None:
    budget = parse_budget("parking,translate=0.01")
    assert (budget.translate, budget.translate_m) == (0.01, 0.5)
    assert format_budget(budget) == "parking,translate=0.01"
    assert parse_budget(format_budget(budget)) == budget
    # As runs from before have it, which a second run must be able to go on with.
    assert format_budget(parse_budget("parking,rotate=2deg")).startswith("rotate=0.0349")


def _cars_of_different_lengths(street):
    scene, length_m = street(), torch.tensor([4.0, 12.0, 1.6, 5.0])
    size_lhw = torch.cat([length_m[:, None], scene.objects.size_lhw[:, 1:]], dim=1)
    return scene.with_objects(size_lhw=size_lhw), length_m


def test_metres_are_the_same_for_long_and_short_cars(street):
    scene, length_m = _cars_of_different_lengths(street)
    space = ParameterSpace(scene, ("translate", "rotate"), parse_budget("parking"))
    reach_m = (space.upper[:8].reshape(4, 2) * length_m[:, None]).tolist()
    # A quarter of the third car's own length is less than half a metre.
    assert reach_m == [pytest.approx([m, m]) for m in (0.5, 0.5, 0.4, 0.5)]
    assert torch.equal(space.lower, -space.upper)
    assert space.upper[8:].tolist() == pytest.approx([math.radians(5)] * 4)
    far = FeasibleSet(space).project(space.theta0 + 1).theta
    assert bool((far <= space.upper).all())
    moved = space.apply(scene, space.upper).objects.translation - scene.objects.translation
    assert float(moved.norm(dim=1).max()) <= 0.5 * math.sqrt(2) + 1e-5


def test_a_street_is_longer_along_than_across(street):
    scene, length_m = _cars_of_different_lengths(street)
    budget = parse_budget("street")
    space = ParameterSpace(scene, tuple(Parameter), budget)
    where = space.blocks.get(Parameter.TRANSLATE)
    along_m, across_m = (space.upper[where].reshape(4, 2) * length_m[:, None]).T.tolist()
    away_m = budget.distance_share * scene.objects.translation.norm(dim=1)
    assert 2.5 < away_m[0] < 3 < away_m[1] < 4 < away_m[2]
    assert along_m == pytest.approx([float(away_m[0]), float(away_m[1]), budget.translate * 1.6, 4.0])
    assert across_m == pytest.approx([1.0] * 4)
    # All else goes as far as the paper's.
    papers = ParameterSpace(scene, PAPER_PARAMETERS, Budget(night=1.0, snow=1.0))
    size = space.blocks.get(Parameter.SIZE)
    assert space.upper[size].tolist() == pytest.approx([0.1] * 4)
    assert space.upper[size.stop :].tolist() == [1.0] * 7  # the sun's and the lamps'
    wider = papers.upper != space.upper[: size.start]
    assert not bool(wider[: where.start].any() or wider[where.stop :].any())


def test_a_street_has_nights_and_snow_and_its_older_runs_have_none(street):
    names = [f"weather.{name}" for name in ("fog", "rain", "time_of_day", "overcast")]
    budget = parse_budget("street")
    assert (budget.night, parse_budget("street,night=0.5").night, parse_budget("street,night=0").night) == (
        1,
        0.5,
        0,
    )
    assert (budget.snow, parse_budget("street,snow=0.5").snow, PRESETS["paper"].snow) == (1, 0.5, 0)
    assert budget_for_coordinates(budget, [*names, "weather.night", "weather.snow"]) == budget
    assert budget_for_coordinates(budget, [*names, "weather.night"]) == parse_budget("street,snow=0")
    older = budget_for_coordinates(budget, names)
    assert older == parse_budget("street,night=0,snow=0")
    assert parse_budget(format_budget(older)) == older
    space = ParameterSpace(street(), ("weather",), older)
    assert [space.name(i) for i in range(space.dim)] == names
    for preset in ("paper", "parking"):
        assert budget_for_coordinates(PRESETS[preset], names) == PRESETS[preset]
    with pytest.raises(FormatError, match=r"night: expected street,night=0\.5, since only street lets it change"):
        parse_budget("night=0.5")
    with pytest.raises(FormatError, match="night: expected a positive number of at most 1, found 2"):
        parse_budget("street,night=2")


def test_partly_visible_cars_have_the_papers_limits(street):
    scene = street().with_objects(
        occlusion=torch.tensor([0, 1, 0, 0]), truncation=torch.tensor([0.0, 0.0, 0.3, 0.1])
    )
    space = ParameterSpace(scene, ("translate",), parse_budget("street"))
    along = space.upper.reshape(4, 2)[:, 0].tolist()
    assert along[1] == along[2] == 0.25
    assert 0.5 < along[0] < along[3]
    # Its size is held: what grows out of its hiding place was not photographed.
    assert ParameterSpace(scene, ("size",), parse_budget("street")).upper.tolist() == pytest.approx(
        [0.1, 0, 0, 0.1]
    )
    sizes = scene.objects.size_lhw.clone()
    sizes[1] *= 1.05
    found = check_scene(scene, scene.with_objects(size_lhw=sizes), limits=change_limits(parse_budget("street")))
    assert found == ["objects[1]: size changed by 5.0 %"]
    # In the paper's budget it makes no difference.
    assert ParameterSpace(scene, ("translate",)).upper.tolist() == [0.25] * 8


def test_the_papers_budget_is_the_same_for_all(street):
    space = ParameterSpace(street(), ("translate",))
    assert space.upper.tolist() == [0.25] * 8


def test_metres_must_be_positive():
    with pytest.raises(RangeError, match=r"budget\.translate_m: expected a positive number, found 0"):
        Budget(translate_m=0.0)
    with pytest.raises(RangeError, match=r"budget\.translate: expected a positive number, found inf"):
        Budget(translate=math.inf)
