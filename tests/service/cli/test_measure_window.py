"""``tidegate measure --window``: which signals it takes, in which unit, and what it says of others."""

import pytest

from engine.core.breath import SignalChoice
from engine.core.errors import InvalidValueError
from engine.gating.windows import AmplitudeWindow
from engine.motion.named_regions import NamedRegion
from service.cli.measure.options import window

POINTS = ((10, 20), (30, 40))
NAMED = tuple(
    NamedRegion(name=name, vertices=((20.0, 40.0), (20.0, 160.0), (120.0, 100.0))) for name in ("chest", "belly")
)


@pytest.mark.parametrize(
    ("text", "choice", "unit"),
    [
        ("whole:-1:3", SignalChoice(), "mm"),
        ("abdomen:-1:3", SignalChoice(signal="abdomen"), "mm"),
        ("volume:-0.1:0.2", SignalChoice(signal="volume"), "l"),
        ("p30_40:-1:3", SignalChoice(signal="point", row=30, column=40, index=1), "mm"),
        ("belly:-1:3", SignalChoice(signal="named", name="belly", index=1), "mm"),
    ],
)
def test_every_signal_that_is_measured_can_be_gated_on(text, choice, unit):
    _, lower, upper = text.split(":")
    made = AmplitudeWindow(choice=choice, lower=float(lower), upper=float(upper), unit=unit)
    assert window(text, POINTS, NAMED) == made


@pytest.mark.parametrize("text", ["p1_2:0:1", "liver:0:1", "region:0:1", "point:0:1", "named:0:1", ":0:1"])
def test_a_signal_that_is_not_measured_is_refused_with_those_that_are(text):
    with pytest.raises(InvalidValueError, match="whole, thorax, abdomen, volume, p10_20, p30_40, chest, belly"):
        window(text, POINTS, NAMED)


@pytest.mark.parametrize(
    ("text", "field"), [("volume:0:30", "upper_l"), ("whole:3:-1", "upper_mm"), ("whole:1", "window")]
)
def test_edges_are_bounded_in_their_own_unit(text, field):
    with pytest.raises(InvalidValueError) as caught:
        window(text)
    assert caught.value.field == field
