"""What is armed is what was looked at: window, its correction and times, reference, model and head direction."""

from dataclasses import replace

import pytest

from engine.core.commands import ActivateModel, Arm, CorrectBaseline, SetReference
from engine.core.errors import CommandRefusedError
from engine.core.signals import HeadDirection
from engine.gating.active_window import SetWindow
from engine.gating.windows import amplitude_window
from tests.support.control.loop_bench import Bench, after, good
from tests.support.gating.streams import LEVEL_MM, LIMITS

AROUND = amplitude_window(lower_mm=LEVEL_MM - 0.5, upper_mm=LEVEL_MM + 0.5)


def set_to(window, **times):
    usual = {"dwell_ms": LIMITS.dwell_ms, "min_on_ms": 0.0, "min_off_ms": 0.0, "max_cycles_per_min": 120}
    return SetWindow(operator="bob", window=window, **{**usual, **times})


CHANGES = {
    "nothing": (),
    "window": (set_to(AROUND),),
    "dwell": (set_to(LIMITS.window, dwell_ms=200.0),),
    "shortest on": (set_to(LIMITS.window, min_on_ms=200.0),),
    "shortest off": (set_to(LIMITS.window, min_off_ms=200.0),),
    "cycles": (set_to(LIMITS.window, max_cycles_per_min=60),),
    "correction": (CorrectBaseline(operator="bob", by=0.5),),
    "reference": (SetReference(operator="bob", reason="as the test wants it"),),
    "model": (ActivateModel(operator="bob", model=object()),),
}


def bench_with(*, at_once, **limits):
    """A bench on which ann looks at frame 3, something changes, and she arms at once or some frames later."""
    bench, seen = Bench([good] * 3, limits=replace(LIMITS, **limits)), []

    def look():
        seen.append(bench.loop.status.arming_state)

    def change_and_arm(changes):
        for one in changes:
            bench.ask(one)()
        if at_once:
            arm()

    def arm():
        bench.ask(Arm(operator="ann", head_direction=bench.loop._limits.current.head_direction, seen=seen[0]))()

    return bench, look, change_and_arm, arm


@pytest.mark.parametrize("at_once", [True, False], ids=["between check and command", "frames later"])
@pytest.mark.parametrize("what", CHANGES)
def test_an_arming_for_something_else_than_was_looked_at_is_refused(what, at_once):
    bench, look, change_and_arm, arm = bench_with(at_once=at_once)
    bench.source.script += [after(look), after(lambda: change_and_arm(CHANGES[what])), *[good] * 3]
    bench.source.script += [*([] if at_once else [after(arm)]), *[good] * 8]
    bench.run()
    refused = bench.answers[-1].exception(timeout=0)
    if what == "nothing":
        assert refused is None
        assert bench.records()[-1].line_on
    else:
        assert all(one.exception(timeout=0) is None for one in bench.answers[:-1])
        assert isinstance(refused, CommandRefusedError)
        assert "look again" in str(refused)
        assert not any(record.line_on for record in bench.records())


def test_another_head_direction_is_another_state():
    states = []
    for head in (HeadDirection.TOP, HeadDirection.BOTTOM, None):
        bench = Bench([good] * 3, limits=replace(LIMITS, head_direction=head))
        bench.run()
        states.append(bench.loop.status.arming_state)
    assert len(set(states)) == 3


def test_the_state_is_the_same_while_nothing_is_decided():
    bench, states = Bench([good] * 3), []
    bench.source.script += [after(lambda: states.append(bench.loop.status.arming_state)) for _ in range(20)]
    bench.run()
    assert len(set(states)) == 1
    assert len(states[0]) == 32
