"""A frame that is measured, and doubted because camera or couch moved, is a lost one to the gate and no other."""

from dataclasses import replace

import pytest

from engine.core.commands import Arm, SetReference
from engine.core.errors import CommandRefusedError
from engine.core.frames import Lost, LostReason, MeasurementState, Mover, RoomChange
from engine.core.gate_state import GateState, HoldReason
from tests.support.control.armed_bench import ON, on_bench
from tests.support.control.loop_bench import Bench, after, good
from tests.support.gating.streams import FRAMES_A_DWELL, measured

DOUBT = Lost(
    reason=LostReason.CAMERA_MOVED,
    detail="couch and floor are 2.0 mm from where they were",
    moved=RoomChange(Mover.COUCH, 2.0),
)


def doubted(frame):
    return replace(frame, doubt=DOUBT)


def test_a_frame_without_a_doubt_is_taken_as_it_is():
    frame = measured(0)
    assert frame.as_gated is frame
    assert frame.reason is None


def test_a_doubted_frame_is_taken_for_a_lost_one_with_nothing_that_was_measured():
    gated = doubted(measured(0)).as_gated
    assert (gated.state, gated.lost, gated.reason) == (MeasurementState.LOST, DOUBT, DOUBT)
    assert (gated.motion, gated.position, gated.evidence, gated.breaths, gated.doubt) == (None, None, None, (), None)
    assert replace(gated, state=MeasurementState.MEASURING) is not gated


def test_the_line_is_off_while_frames_are_doubted_and_on_again_after_a_dwell_and_their_motion_is_kept():
    bench = on_bench([good] * 12)
    bench.pipeline.spoil.update(dict.fromkeys(range(ON + 2, ON + 6), doubted))
    records = bench.run().records()
    assert records[ON + 1].line_on
    for record in records[ON + 2 : ON + 6]:
        assert (record.gate_state, record.hold_reason) == (GateState.HOLD, HoldReason.CAMERA_MOVED)
        assert not record.line_on
        assert record.measurement.motion is not None
    assert [one.line_on for one in records[ON + 6 :]] == [False] * (FRAMES_A_DWELL - 1) + [True] * (
        len(records) - ON - 5 - FRAMES_A_DWELL
    )


def asked(command):
    """Ask behind three doubted frames; return the answer's error, and the bench."""
    bench = Bench([])
    bench.pipeline.spoil.update(dict.fromkeys(range(10), doubted))
    bench.source.script = [good] * 3 + [after(bench.ask(command)), good, good]
    bench.run()
    return bench.answers[-1].exception(timeout=0), bench


def test_arming_is_refused_with_what_has_moved():
    error, bench = asked(Arm(operator="ann"))
    assert isinstance(error, CommandRefusedError)
    assert str(error) == DOUBT.detail
    assert bench.loop.gate.state is GateState.DISARMED


@pytest.mark.parametrize("seen_mm", [1.5, 2.0, 2.5])
def test_a_person_who_was_shown_the_movement_accepts_it_with_the_reference(seen_mm):
    error, bench = asked(SetReference(operator="ann", reason="the couch was moved", move_seen_mm=seen_mm))
    assert error is None
    assert len(bench.pipeline.moments) == 1


@pytest.mark.parametrize(
    ("seen_mm", "text"),
    [
        (None, "the couch has moved by 2.0 mm since the reference: confirm it with move_seen_mm"),
        (1.4, "the couch has moved by 2.0 mm since the reference, not 1.4 mm: look again"),
        (2.6, "the couch has moved by 2.0 mm since the reference, not 2.6 mm: look again"),
    ],
)
def test_a_reference_does_not_accept_a_movement_that_its_person_was_not_shown(seen_mm, text):
    error, bench = asked(SetReference(operator="ann", reason="the couch was moved", move_seen_mm=seen_mm))
    assert isinstance(error, CommandRefusedError)
    assert str(error) == text
    assert bench.pipeline.moments == []


def test_a_movement_that_is_over_cannot_be_accepted():
    bench = Bench([])
    command = SetReference(operator="ann", reason="the couch was moved", move_seen_mm=2.0)
    bench.source.script = [good] * 3 + [after(bench.ask(command)), good, good]
    bench.run()
    assert "no movement of couch or camera is seen by now" in str(bench.answers[-1].exception(timeout=0))
    assert bench.pipeline.moments == []


@pytest.mark.parametrize("reason", LostReason)
def test_whatever_the_doubt_the_gate_holds_for_it_as_for_a_loss(reason):
    def spoiled(frame, *, is_doubt):
        lost = Lost(reason=reason, detail="as the test wants it")
        if is_doubt:
            return replace(frame, doubt=lost)
        return replace(frame, state=MeasurementState.LOST, motion=None, lost=lost)

    found = []
    for is_doubt in (False, True):
        bench = on_bench([good] * 6)
        bench.pipeline.spoil[ON + 2] = lambda frame, is_doubt=is_doubt: spoiled(frame, is_doubt=is_doubt)
        found.append([(one.gate_state, one.hold_reason, one.line_on) for one in bench.run().records()])
    assert found[0] == found[1]
