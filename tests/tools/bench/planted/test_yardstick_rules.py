"""Whether a rule is the fault that was planted."""

import pytest

from detectors.planted import Band, PlantedFault
from tools.bench.planted.yardstick import rule_names_fault

PAIR = PlantedFault.parse("aspect=1:2,lightness=0.2:0.4")
BANDS = (Band("aspect", 1.1, 1.9), Band("lightness", 0.2, 0.4))


@pytest.mark.parametrize(
    ("where", "whole", "in_part"),
    [
        ({"aspect": (1.0, 1.8), "lightness": (0.22, 0.45)}, True, True),
        ({"aspect": (1.0, 1.8)}, False, True),  # one of two
        ({"aspect": (1.0, 1.8), "distance_m": (3.0, 9.0)}, False, True),  # and one that is none of the fault's
        ({"aspect": (1.8, 3.0), "lightness": (0.22, 0.45)}, False, True),  # elsewhere
        ({"aspect": (0.0, 9.0)}, False, False),  # everywhere
        ({"distance_m": (3.0, 9.0)}, False, False),
        ({}, False, False),
    ],
)
def test_a_rule_names_a_fault(where: dict[str, tuple[float, float]], whole: bool, in_part: bool) -> None:
    assert rule_names_fault(where, PAIR, BANDS) == (whole, in_part)


def test_a_fault_that_hides_nothing_is_not_named() -> None:
    assert rule_names_fault({"aspect": (1.0, 2.0)}, PlantedFault.parse("aspect=1:2"), ()) == (False, False)
