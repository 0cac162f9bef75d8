"""A turn's readings on a tape, and read from it."""

import json
from concurrent.futures import Future
from dataclasses import fields, replace

import pytest

from engine.control.turn_inputs import CommandInputs, FrameInput, LineAnswer, QueuedCommand, TurnInputs
from engine.core.clock import ManualClock
from engine.core.commands import Arm
from engine.core.errors import BeamLineMismatchError
from engine.core.gate_state import HoldReason
from engine.core.input_tap import InputKind
from engine.gating.gate import Interruption
from engine.gating.interlocks import DecisionInputs
from engine.offline.replay.encoding import kept_of
from engine.offline.replay.tape_file import OtherReadingError, RecordedReadings
from tests.support.control.loop_bench import ScriptedSource, good
from tests.support.replay.scripted_tape import NO_MODELS

ANNA = Arm(operator="anna")

DECIDED = DecisionInputs(
    at_ns=100,
    watchdog_fired=True,
    is_watchdog_running=False,
    reported_fault=Interruption(HoldReason.DISK_LOW, "full"),
    queue_trouble=HoldReason.AUDIT_BEHIND,
    write_delay=(HoldReason.RECORDER_BEHIND, "600 ms"),
    operator_absence="absent",
    disarm_requested_by="anna",
    hold_requested_by="bert",
)


def values_of(answer):
    return {one.name: getattr(answer, one.name) for one in fields(answer)}


# Values on a tape. Their encoding is pinned: defaults are omitted, so a default that changes would alter old tapes.

ENCODED = {
    "turn": (TurnInputs(), "TurnInputs", {}),
    "stop": (TurnInputs(is_stop_requested=True), "TurnInputs", {"is_stop_requested": True}),
    "command": (CommandInputs(), "CommandInputs", {}),
    "unwanted": (
        CommandInputs(is_wanted=False, is_watchdog_running=False, queue_trouble=HoldReason.AUDIT_BEHIND),
        "CommandInputs",
        {
            "is_wanted": False,
            "is_watchdog_running": False,
            "queue_trouble": {"e": ["HoldReason", "audit_behind"]},
        },
    ),
    "time-out": (FrameInput(at_ns=7), "FrameInput", {"at_ns": 7}),
    "away": (FrameInput(away="unplugged", at_ns=7), "FrameInput", {"away": "unplugged", "at_ns": 7}),
    "clear": (DecisionInputs(at_ns=7), "DecisionInputs", {"at_ns": 7}),
    "interlocks": (
        replace(DECIDED, is_stop_requested=True),
        "DecisionInputs",
        {
            "at_ns": 100,
            "watchdog_fired": True,
            "is_watchdog_running": False,
            "reported_fault": {"d": ["Interruption", {"reason": {"e": ["HoldReason", "disk_low"]}, "detail": "full"}]},
            "queue_trouble": {"e": ["HoldReason", "audit_behind"]},
            "write_delay": {"t": [{"e": ["HoldReason", "recorder_behind"]}, "600 ms"]},
            "operator_absence": "absent",
            "disarm_requested_by": "anna",
            "hold_requested_by": "bert",
            "is_stop_requested": True,
        },
    ),
    "line": (LineAnswer(at_ns=7), "LineAnswer", {"at_ns": 7}),
    "held": (
        LineAnswer(is_on=False, is_settling=True, watchdog_fired=True, at_ns=7),
        "LineAnswer",
        {"is_on": False, "is_settling": True, "watchdog_fired": True, "at_ns": 7},
    ),
}


@pytest.mark.parametrize("name", ENCODED)
def test_a_value_is_on_the_tape_without_its_defaults_and_is_read_as_it_was(name):
    value, kind, stored = ENCODED[name]
    encoded = NO_MODELS.encode(value)
    assert encoded == {"d": [kind, stored]}
    assert values_of(NO_MODELS.decode(json.loads(json.dumps(encoded)))) == values_of(value)


def test_commands_frames_and_errors_are_on_the_tape_without_what_cannot_be_stored():
    source = ScriptedSource(ManualClock(0), [good])
    frame = source.read(1.0)
    queued = QueuedCommand(command=ANNA, answer=Future(), submitted_ns=3)
    error = BeamLineMismatchError("off though commanded on")
    kept = [
        kept_of(InputKind.TURN, TurnInputs(commands=(queued,))),
        kept_of(InputKind.FRAME, FrameInput(frame=frame, at_ns=8)),
        kept_of(InputKind.LINE, LineAnswer(error=error, at_ns=9)),
    ]
    turn, read, line = (NO_MODELS.decode(json.loads(json.dumps(NO_MODELS.encode(one)))) for one in kept)
    assert turn.commands == (ANNA,)
    assert (read.frame.index, read.frame.timestamp_us) == (frame.index, frame.timestamp_us)
    again = line.error.again()
    assert (type(again), str(again)) == (BeamLineMismatchError, "off though commanded on")


def test_recorded_values_come_in_order_and_another_kind_is_named():
    readings = RecordedReadings([(InputKind.CLOCK, 5), (InputKind.TURN, "turn")], lambda value: value)
    assert readings.take(InputKind.CLOCK) == 5
    with pytest.raises(OtherReadingError) as other:
        readings.take(InputKind.DECISION)
    assert other.value.name == "TURN"
    assert readings.rest() is None
