"""The distance of a reference is the largest of what moved; what is not known is beyond every budget."""

import math

import pytest

from engine.core.breath import WHOLE, SignalChoice
from engine.core.reference import ReferenceDistance, SignalLevel

VOLUME, ABDOMEN = SignalChoice(signal="volume"), SignalChoice(signal="abdomen")


def distance(moved_mm, *levels, correction=0.0):
    return ReferenceDistance(moved_mm=moved_mm, levels=levels, correction=correction)


@pytest.mark.parametrize(
    ("found", "expected_mm"),
    [
        (distance(1.2, SignalLevel(WHOLE, -0.3)), 1.2),
        (distance(0.2, SignalLevel(WHOLE, -1.3)), 1.3),
        (distance(0.2, SignalLevel(WHOLE, 0.1), SignalLevel(ABDOMEN, 2.5)), 2.5),
        (distance(0.2, SignalLevel(VOLUME, -0.3)), 3.0),
        (distance(0.2, SignalLevel(WHOLE, -1.3), correction=1.0), 0.3),
        (distance(0.2, SignalLevel(WHOLE, 0.0), SignalLevel(ABDOMEN, 0.5), correction=-1.0), 1.0),
    ],
)
def test_it_is_the_largest_of_the_surface_and_of_each_gated_signal_with_the_correction_of_the_first(found, expected_mm):
    assert found.distance_mm == pytest.approx(expected_mm)
    assert found.is_within(expected_mm + 0.001)
    assert not found.is_within(expected_mm - 0.001)


@pytest.mark.parametrize(
    "found",
    [
        ReferenceDistance(unknown="the camera was disconnected since"),
        ReferenceDistance(moved_mm=0.1, levels=(SignalLevel(WHOLE, 0.1),), unknown="measured with other regions"),
        distance(math.nan, SignalLevel(WHOLE, 0.1)),
        distance(0.1, SignalLevel(WHOLE, 0.1), SignalLevel(ABDOMEN, math.nan)),
    ],
)
def test_what_is_not_known_is_within_no_budget(found):
    assert found.distance_mm is None
    assert not found.is_within(1e9)
    assert found.is_within(None)
    assert "unknown distance from the fraction's first" in found.text


def test_corrections_add_up():
    assert distance(0.0, SignalLevel(WHOLE, 0.0)).corrected(1.5).corrected(1.5).distance_mm == 3.0
