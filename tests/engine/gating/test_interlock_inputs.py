"""Interlocks by construction: each input stands against the beam by its own reason, in order of precedence."""

from dataclasses import fields, replace

import pytest

from engine.core.gate_state import HoldReason
from engine.gating.gate import Interruption
from engine.gating.interlocks import (
    NOT_CALIBRATED,
    QUEUE_FULL,
    WATCHDOG_DETAIL,
    WATCHDOG_GONE,
    DecisionInputs,
    interlocks,
)
from tests.support.gating.streams import LIMITS

CLEAR = DecisionInputs(at_ns=1)
FAULT = Interruption(HoldReason.DISK_LOW, "almost full")
SHIFTED = Interruption(HoldReason.PATIENT_SHIFTED, "10 mm")

FOUND = {
    "watchdog_fired": (True, Interruption(HoldReason.WATCHDOG, WATCHDOG_DETAIL)),
    "is_watchdog_running": (False, Interruption(HoldReason.WATCHDOG, WATCHDOG_GONE)),
    "reported_fault": (FAULT, FAULT),
    "queue_trouble": (HoldReason.AUDIT_BEHIND, Interruption(HoldReason.AUDIT_BEHIND, QUEUE_FULL)),
    "write_delay": ((HoldReason.RECORDER_BEHIND, "600 ms"), Interruption(HoldReason.RECORDER_BEHIND, "600 ms")),
    "operator_absence": ("no message", Interruption(HoldReason.OPERATOR_LOST, "no message")),
    "disarm_requested_by": ("anna", Interruption(HoldReason.DISARMED, "anna disarms")),
    "hold_requested_by": ("bert", Interruption(HoldReason.OPERATOR_HOLD, "held by bert")),
}
"""Each input that stands against the beam, in order of precedence, and its finding."""


def test_every_input_is_in_the_table_but_the_time_and_the_stop():
    assert [one.name for one in fields(DecisionInputs)] == ["at_ns", *FOUND, "is_stop_requested"]


def test_nothing_stands_against_the_beam_by_default():
    assert interlocks(CLEAR, is_armed=True, limits=LIMITS) == []


@pytest.mark.parametrize("name", FOUND)
def test_each_input_alone_is_found(name):
    value, finding = FOUND[name]
    assert interlocks(replace(CLEAR, **{name: value}), is_armed=True, limits=LIMITS) == [finding]


def test_all_are_found_in_order_of_precedence():
    everything = replace(CLEAR, **{name: value for name, (value, _finding) in FOUND.items()})
    found = interlocks(
        everything, is_armed=True, limits=replace(LIMITS, is_calibrated=False), supervision=[SHIFTED, SHIFTED]
    )
    of_the_engine = [finding for _value, finding in FOUND.values()][:5]
    of_the_operator = [finding for _value, finding in FOUND.values()][5:]
    missing = Interruption(HoldReason.CALIBRATION_MISSING, NOT_CALIBRATED)
    assert found == [*of_the_engine, SHIFTED, SHIFTED, missing, *of_the_operator]


def test_a_watchdog_that_does_not_run_matters_only_while_armed():
    gone = replace(CLEAR, is_watchdog_running=False)
    assert interlocks(gone, is_armed=False, limits=LIMITS) == []


def test_the_operator_who_holds_is_named_before_the_one_whose_hold_waits():
    waiting = replace(CLEAR, hold_requested_by="bert")
    (found,) = interlocks(waiting, is_armed=True, limits=LIMITS, operator_hold="anna")
    assert found == Interruption(HoldReason.OPERATOR_HOLD, "held by anna")
    assert interlocks(CLEAR, is_armed=True, limits=LIMITS, operator_hold="anna") == [found]
