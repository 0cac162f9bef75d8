"""A turn's readings: as values, and single readings of earlier tapes grouped into the same values."""

import json
from concurrent.futures import Future
from dataclasses import fields, replace

import pytest

from engine.control.command_queue import QueuedCommand
from engine.control.turn_inputs import CommandInputs, FrameInput, LineAnswer, TurnInputs
from engine.core.clock import ManualClock
from engine.core.commands import Arm
from engine.core.errors import BeamLineMismatchError, RecordingError
from engine.core.gate_state import HoldReason
from engine.core.input_tap import InputKind
from engine.gating.gate import Interruption
from engine.gating.interlocks import DecisionInputs
from engine.offline.replay.earlier_readings import EarlierKind, EarlierReadings
from engine.offline.replay.inputs import FrameHead, Raised, kept_of
from engine.offline.replay.readings import OtherReadingError, RecordedReadings
from tests.support.control.loop_bench import ScriptedSource, good
from tests.support.replay.scripted_tape import NO_MODELS

K = EarlierKind
ANNA = Arm(operator="anna")
HEAD = FrameHead(index=3, device_index=4, missed_frames=0, timestamp_us=5, color_timestamp_us=6, received_ns=70)
REFUSED = Raised(name="BeamLineError", text="no")
AWAY, LATE = Raised(name="SourceAwayError", text="unplugged"), Raised(name="FrameTimeoutError", text="")

# The order of the readings of a decision in ``tidegate.tape/1``, with the ones that it did not always make.
DECISION = [
    (K.CLOCK, 100),
    (K.WATCHDOG_FIRED, True),
    (K.WATCHDOG_RUNS, False),
    (K.REPORTED_FAULT, Interruption(HoldReason.DISK_LOW, "full")),
    (K.QUEUE_TROUBLE, HoldReason.AUDIT_BEHIND),
    (K.WRITE_DELAY, (HoldReason.RECORDER_BEHIND, "600 ms")),
    (K.OPERATOR_ABSENCE, "absent"),
    (K.DISARM_REQUESTED, "anna"),
    (K.HOLD_REQUESTED, "bert"),
]
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
CLEAR = [
    (K.CLOCK, 100),
    (K.WATCHDOG_FIRED, False),
    (K.REPORTED_FAULT, None),
    (K.QUEUE_TROUBLE, None),
    (K.OPERATOR_ABSENCE, ""),
    (K.DISARM_REQUESTED, None),
]


def earlier(*observed):
    return EarlierReadings(observed, lambda value: value)


def values_of(answer):
    return {one.name: getattr(answer, one.name) for one in fields(answer)}


def answered(**values):
    return values_of(LineAnswer(**values))


def test_a_decision_is_grouped_and_what_was_not_read_had_no_effect():
    assert earlier(*DECISION).take(InputKind.DECISION) == DECIDED
    assert earlier(*CLEAR).take(InputKind.DECISION) == DecisionInputs(at_ns=100)


def test_a_stop_during_the_measuring_belongs_to_the_decision_and_a_turns_own_does_not():
    readings = earlier((K.STOP_REQUESTED, False), (K.COMMANDS, [ANNA]), (K.STOP_REQUESTED, True), *CLEAR)
    assert readings.take(InputKind.TURN).commands == (ANNA,)
    assert readings.take(InputKind.DECISION) == DecisionInputs(at_ns=100, is_stop_requested=True)
    assert earlier((K.STOP_REQUESTED, True)).take(InputKind.TURN).is_stop_requested


def test_a_clock_that_is_read_no_more_is_skipped_before_a_decision_and_at_the_end():
    readings = earlier((K.CLOCK, 98), (K.CLOCK, 99), *CLEAR, (K.CLOCK, 101))
    assert readings.take(InputKind.DECISION) == DecisionInputs(at_ns=100)
    assert readings.rest() is None


def test_a_command_has_what_was_read_for_its_kind():
    assert earlier((K.COMMAND_IS_WANTED, True), *CLEAR).take(InputKind.COMMAND) == CommandInputs()
    arm = earlier((K.COMMAND_IS_WANTED, True), (K.WATCHDOG_RUNS, False), (K.CLOCK, 99), (K.LINE, None), *CLEAR)
    assert arm.take(InputKind.COMMAND) == CommandInputs(is_watchdog_running=False)
    assert arm.take(InputKind.CLOCK) == 99
    assert arm.take(InputKind.LINE).error is None
    assert arm.take(InputKind.DECISION).at_ns == 100, "the time is not the rearmed line's"
    acknowledge = earlier((K.COMMAND_IS_WANTED, False), (K.QUEUE_TROUBLE, HoldReason.AUDIT_BEHIND))
    assert acknowledge.take(InputKind.COMMAND) == CommandInputs(is_wanted=False, queue_trouble=HoldReason.AUDIT_BEHIND)


def test_frames_time_outs_and_errors_of_a_source():
    assert values_of(earlier((K.CLOCK, 1), (K.FRAME, HEAD)).take(InputKind.FRAME)) == values_of(
        FrameInput(frame=HEAD, at_ns=70)
    )
    asserted, waited = (K.CLOCK, 110), (K.CLOCK, 120)
    late = earlier((K.FRAME, LATE), *CLEAR, (K.LINE, None), (K.LINE, False), (K.LINE, False), asserted, waited)
    assert values_of(late.take(InputKind.FRAME)) == values_of(FrameInput(at_ns=120))
    away = earlier((K.FRAME, AWAY), *CLEAR).take(InputKind.FRAME)
    assert (away.frame, away.away) == (None, "unplugged")
    ended = Raised(name="SourceEndedError", text="over")
    assert earlier((K.FRAME, ended)).take(InputKind.FRAME) is ended


@pytest.mark.parametrize(
    ("lines", "answer"),
    [
        ([None, False, False, False], answered(is_on=False, at_ns=9)),
        ([None, False, True, False], answered(is_on=True, at_ns=9)),
        ([None, False, True, True], answered(is_on=True, is_settling=True, at_ns=9)),
        ([None, True, False], answered(is_on=False, is_settling=True, at_ns=9)),
        ([REFUSED], answered(error=REFUSED, at_ns=9)),
        ([None, True, REFUSED], answered(error=REFUSED, at_ns=9)),
    ],
)
def test_the_answers_to_an_order_are_one_value(lines, answer):
    readings = earlier(*((K.LINE, line) for line in lines), (K.CLOCK, 9), *CLEAR)
    assert values_of(readings.take(InputKind.LINE)) == answer
    assert readings.take(InputKind.DECISION).at_ns == 100


def test_a_refused_permit_its_hold_and_the_watchdog_that_is_the_cause():
    hold = [(K.LINE, None), (K.LINE, False), (K.LINE, False), (K.LINE, False)]
    readings = earlier((K.LINE, REFUSED), (K.CLOCK, 8), *hold, (K.WATCHDOG_FIRED, True), (K.CLOCK, 9), *CLEAR)
    assert values_of(readings.take(InputKind.LINE)) == answered(error=REFUSED, at_ns=8)
    assert values_of(readings.take(InputKind.LINE)) == answered(is_on=False, watchdog_fired=True, at_ns=9)
    assert readings.take(InputKind.DECISION).at_ns == 100


def test_a_line_that_stays_on_is_held_again_without_a_read_back():
    stays_on = [(K.LINE, None), (K.LINE, False), (K.LINE, True), (K.LINE, False)]
    readings = earlier(*stays_on, (K.LINE, None), (K.WATCHDOG_FIRED, False), (K.CLOCK, 9), *CLEAR)
    assert values_of(readings.take(InputKind.LINE)) == answered(is_on=True, at_ns=9)
    assert values_of(readings.take(InputKind.LINE)) == answered(is_on=True, at_ns=9)
    assert readings.take(InputKind.DECISION).at_ns == 100


def test_a_line_is_connected_without_a_time():
    readings = earlier((K.LINE, None), (K.LINE, None), (K.SOURCE_OPENED, "description"), (K.CLOCK, 5))
    for _ in range(2):
        assert readings.take(InputKind.LINE).error is None
    assert [readings.take(kind) for kind in (InputKind.SOURCE_OPENED, InputKind.CLOCK)] == ["description", 5]


def test_a_hold_that_was_read_for_a_records_name_is_skipped():
    readings = earlier(*CLEAR, (K.HOLD_REQUESTED, None), (K.HOLD_REQUESTED, "bert"), (K.WATCHDOG_RECORDED, True))
    assert readings.take(InputKind.DECISION).hold_requested_by is None
    assert readings.take(InputKind.WATCHDOG_RECORDED) is True


def test_another_reading_is_named_and_damage_is_reported():
    with pytest.raises(OtherReadingError) as other:
        earlier(*CLEAR).take(InputKind.FRAME)
    assert other.value.name == "WATCHDOG_FIRED"
    assert earlier((K.TRAINED, True)).rest() == "TRAINED"
    with pytest.raises(RecordingError, match="damaged"):
        earlier((K.STOP_REQUESTED, False), (K.COMMANDS, None)).take(InputKind.TURN)
    with pytest.raises(RecordingError, match="damaged"):
        earlier((K.FRAME, None)).take(InputKind.FRAME)


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
