"""Which positions are within the tolerance: each degree of freedom has to be known well enough to be compared."""

from dataclasses import replace

import pytest

from engine.core.position_check import Degree, PositionCheck, PositionTolerance

TOLERANCE = PositionTolerance(shift_mm=2.0, turn_deg=1.0, shape_mm=2.0)
GOOD = PositionCheck(
    shift_mm=(1.9, -1.9, 0.5),
    turn_deg=(0.9, -0.9, 0.1),
    shift_uncertainty_mm=(1.0, 0.9, 0.1),
    turn_uncertainty_deg=(0.1, 0.3, 0.5),
    shape_mm=0.6,
)


def test_a_position_within_all_tolerances_has_no_shortcoming():
    assert TOLERANCE.shortcomings(GOOD) == ()
    assert [one.name for one in GOOD.degrees] == ["lateral", "longitudinal", "vertical", "pitch", "roll", "yaw"]
    assert [one.unit for one in GOOD.degrees] == ["mm"] * 3 + ["deg"] * 3


@pytest.mark.parametrize(
    ("change", "shortcoming"),
    [
        ({"shift_mm": (2.1, 0.0, 0.0)}, "lateral +2.1 mm"),
        ({"shift_mm": (0.0, -2.1, 0.0)}, "longitudinal -2.1 mm"),
        ({"shift_mm": (0.0, 0.0, -2.1)}, "vertical -2.1 mm"),
        ({"turn_deg": (1.1, 0.0, 0.0)}, "pitch +1.1 deg"),
        ({"turn_deg": (0.0, -1.1, 0.0)}, "roll -1.1 deg"),
        ({"turn_deg": (0.0, 0.0, 1.1)}, "yaw +1.1 deg"),
        ({"shape_mm": 2.1}, "shape 2.1 mm"),
        ({"shift_uncertainty_mm": (1.01, 0.1, 0.1)}, "lateral not determined"),
        ({"turn_uncertainty_deg": (0.1, 0.1, 0.51)}, "yaw not determined"),
    ],
)
def test_each_degree_of_freedom_counts(change, shortcoming):
    assert TOLERANCE.shortcomings(replace(GOOD, **change)) == (shortcoming,)


def test_what_is_not_known_is_not_within():
    assert TOLERANCE.shortcomings(PositionCheck(unknown="another camera")) == ("it is not known (another camera)",)
    assert len(TOLERANCE.shortcomings(PositionCheck())) == 7  # six degrees of freedom and the shape
    assert not TOLERANCE.holds(Degree("lateral", float("nan"), 0.1))
    assert not TOLERANCE.determines(Degree("lateral", 0.0, float("nan")))
