"""Arming on a part of the patient needs the head direction, from the session and from the operator who arms."""

from dataclasses import replace

import pytest

from engine.core.commands import Arm
from engine.core.errors import HeadDirectionError
from engine.core.gate_state import GateState
from engine.core.signals import HeadDirection
from engine.gating.windows import amplitude_window
from tests.support.control.armed_bench import LEARNED
from tests.support.control.loop_bench import Bench, after, good
from tests.support.gating.streams import LIMITS

TOP, BOTTOM = HeadDirection.TOP, HeadDirection.BOTTOM
WHOLE = LIMITS.window
THORAX = amplitude_window(signal="thorax", lower_mm=-1.0, upper_mm=3.0)


def _armed(window, lies: HeadDirection | None, confirmed: HeadDirection | None) -> Bench:
    bench = Bench([], limits=replace(LIMITS, window=window, head_direction=lies))
    arm = Arm(operator="ann", head_direction=confirmed)
    bench.source.script = [good] * LEARNED + [after(bench.ask(arm)), *[good] * 8]
    return bench.run()


@pytest.mark.parametrize(
    ("window", "lies", "confirmed", "sentence"),
    [
        (THORAX, None, None, "create the session with head_direction"),
        (THORAX, None, TOP, "confirmed at the top, and in this session it is unknown"),
        (THORAX, TOP, None, "confirm head_direction"),
        (THORAX, TOP, BOTTOM, "confirmed at the bottom, and in this session it is at the top"),
        (WHOLE, TOP, BOTTOM, "confirmed at the bottom, and in this session it is at the top"),
        (WHOLE, None, TOP, "unknown"),
    ],
)
def test_arming_is_refused_without_the_right_head_direction(window, lies, confirmed, sentence):
    bench = _armed(window, lies, confirmed)
    error = bench.answers[0].exception(timeout=0)
    assert isinstance(error, HeadDirectionError)
    assert error.code == "head_direction_missing"
    assert sentence in str(error)
    assert not bench.beam.permits
    assert {record.gate_state for record in bench.records()} == {GateState.DISARMED}


@pytest.mark.parametrize(
    ("window", "lies", "confirmed"), [(THORAX, TOP, TOP), (WHOLE, None, None), (WHOLE, TOP, None), (WHOLE, TOP, TOP)]
)
def test_the_head_direction_that_was_confirmed_lets_the_gate_decide(window, lies, confirmed):
    bench = _armed(window, lies, confirmed)
    assert bench.answers[0].exception(timeout=0) is None
    assert bench.beam.permits
