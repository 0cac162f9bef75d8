"""The one table of alarms: every hold reason is in it or is named as none, and the priorities follow one rule."""

from engine.core.gate_state import HoldReason
from service.core.alarm_table import ALARM_RULES, ALARMS, NOT_ALARMS, AlarmPriority, AlarmScope


def test_every_hold_reason_is_an_alarm_or_is_named_as_none():
    reasons = {reason.value for reason in HoldReason}
    none = {reason.value for reason in NOT_ALARMS}
    assert reasons <= ALARMS.keys() | none
    assert not ALARMS.keys() & none
    assert len(ALARMS) == len(ALARM_RULES), "each code once"


def test_every_fault_latches_and_begins_at_once_and_no_hold_does_latch():
    ways_out = {HoldReason.SOURCE_ENDED, HoldReason.ENGINE_STOPPED}
    for reason in set(HoldReason) - NOT_ALARMS.keys():
        rule = ALARMS[reason.value]
        assert rule.latches is reason.is_fault, reason
        assert rule.scope is (AlarmScope.FAULT if reason.is_fault else AlarmScope.ARMED), reason
        assert not (rule.latches and rule.delay_s), reason
    assert {reason for reason in NOT_ALARMS if reason.is_fault} == ways_out


def test_high_is_where_the_beam_may_be_on_and_nothing_else():
    high = {rule.code for rule in ALARM_RULES if rule.priority is AlarmPriority.HIGH}
    line = {"beam_without_permit", "beam_line_mismatch", "beam_line_failed"}
    assert high == line | {"watchdog", "engine_failed", "unknown"}, "the last three: the line was not read back"


def test_honest_gating_is_no_alarm():
    for reason in ("outside_window", "dwell", "phase_unknown", "breath_hold_awaited", "operator_hold"):
        assert reason not in ALARMS


def test_ceased_breathing_is_an_alarm_like_that_of_the_same_patient_inside_the_window():
    outside, inside = (ALARMS[code] for code in ("breathing_irregular", "beam_on_limit"))
    for name in ("priority", "scope", "delay_s", "ends"):
        assert getattr(outside, name) == getattr(inside, name), name
    assert (outside.priority, outside.delay_s) == (AlarmPriority.LOW, 5.0)


def test_the_table_is_sorted_by_urgency():
    ranks = [rule.priority.rank for rule in ALARM_RULES]
    assert ranks == sorted(ranks)
    assert [priority.rank for priority in AlarmPriority] == [0, 1, 2]
