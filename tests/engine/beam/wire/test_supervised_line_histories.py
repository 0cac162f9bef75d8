"""Any history of permits, holds and lapses: the line never says off while the contact is on, and follows in time."""

import queue
import threading

import pytest
from hypothesis import given, settings, strategies as st

from engine.beam.wire.line_supervisor import LineTimes
from engine.beam.wire.supervised_line import WiredBeamLine
from engine.core.clock import MonotonicClock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason
from tests.support.beam.permit_rain import hold_in_the_rain
from tests.support.beam.stepped_line import World

BEGIN_MS, END_MS = 300, 1_300
FOLLOW_MS = 200
acts = st.lists(
    st.tuples(st.integers(BEGIN_MS, END_MS - 250), st.sampled_from(["permit", "permit", "permit", "hold", "flash"])),
    max_size=40,
)


@settings(max_examples=60, deadline=None)
@given(acts, st.integers(1, 40), st.integers(0, 60))
def test_the_contact_is_on_only_within_a_lease_or_its_way_back_and_never_while_stated_to_be_off(
    story, answer_ms, lag_ms
):
    world = World(LineTimes(answer_ms=100, settle_ms=60), answer_ms=answer_ms, lag_ms=lag_ms).opened()
    ends_ms = [0]  # until when the beam may have been wanted, newest last

    def permit():
        try:
            world.permit(80)
        except BeamLineError:
            return
        ends_ms.append(world.now_ms + 80)

    def hold():
        world.hold()
        ends_ms.append(min(ends_ms[-1], world.now_ms))

    world.at(BEGIN_MS - 50, permit)
    for ms, act in story:
        world.at(ms, permit if act == "permit" else hold)
        if act == "flash":
            world.at(ms + 1, permit)
            world.at(ms + 4, hold)

    def look():
        is_closed = world.wire._at(world.clock.now_ns())
        if is_closed:
            assert world.line.is_on() or world.line.is_settling
            assert world.now_ms <= ends_ms[-1] + FOLLOW_MS

    for ms in range(BEGIN_MS - 50, END_MS):
        world.at(ms, look)
    world.run(to_ms=END_MS)
    assert world.troubles == []
    assert not world.wire._at(world.clock.now_ns())
    assert any(is_on for _, is_on, _ in world.wire.commands)


class _InstantWire:
    name = "memory"

    def __init__(self):
        self.commands: list[bool] = []

    def connect(self):
        """Nothing to do."""

    def exchange(self, *, is_on, **_unused):
        self.commands.append(is_on)
        return is_on

    def close(self):
        """Nothing to do."""


def test_holding_from_many_threads_while_permits_rain_on_a_wired_line_ends_off():
    clock, wire = MonotonicClock(), _InstantWire()
    line = WiredBeamLine(wire, clock)
    line.open()
    while True:
        try:
            line.rearm()
        except BeamLineError:
            threading.Event().wait(0.005)
        else:
            break
    hold_in_the_rain(line, clock, threads=3)
    threading.Event().wait(0.05)
    commands = len(wire.commands)
    assert wire.commands[-1] is False
    threading.Event().wait(0.1)
    assert len(wire.commands) > commands
    assert not any(wire.commands[commands:])
    line.close()


class _HungWire(_InstantWire):
    """Its driver never comes back, from when it is asked to hang."""

    def __init__(self):
        super().__init__()
        self.hangs, self.released = threading.Event(), threading.Event()

    def exchange(self, *, is_on, **_unused):
        if self.hangs.is_set():
            self.released.wait()
        return super().exchange(is_on=is_on)


def test_a_driver_that_hangs_is_latched_by_the_other_thread_without_waiting():
    wire, received = _HungWire(), queue.SimpleQueue()
    line = WiredBeamLine(wire, MonotonicClock())
    line.on_trouble = lambda reason, detail: received.put((reason, detail))
    line.open()
    wire.hangs.set()
    reason, detail = received.get(timeout=20.0)
    assert reason is HoldReason.BEAM_LINE_FAILED
    assert detail.startswith("the beam line has not answered for")
    with pytest.raises(BeamLineError, match="has not answered"):
        line.is_on()
    with pytest.raises(BeamLineError, match="has not answered"):
        line.rearm()
    line.hold(HoldReason.WATCHDOG)
    line.close()  # comes back, though the thread does not
    wire.released.set()
