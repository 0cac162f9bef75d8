"""The time from each hold to the beam off, written to the audit and summed up."""

from dataclasses import replace

import pytest

from engine.beam.beam_on import KEPT_OFFS, BeamOff, BeamOnState
from service.sessions.lifecycle.counters import BeamOffs
from tests.support.service.api_calls import act, audit_rows
from tests.support.service.fake_engine import FakeRunning
from tests.support.waiting import eventually


def offs(*numbers: int) -> tuple[BeamOff, ...]:
    return tuple(BeamOff(number=number, ended_ns=number * 1_000_000_000, off_ms=40.0 + number) for number in numbers)


def view(*numbers: int):
    running = FakeRunning(plan=None)
    running.beam_on = BeamOnState(newest_offs=offs(*numbers))
    running.frame()
    return running.latest


def test_each_hold_is_taken_once_and_in_order():
    taken = BeamOffs()
    assert [one.number for one in taken.take(view(1, 2))] == [1, 2]
    assert taken.take(view(1, 2)) == []
    assert [one.number for one in taken.take(view(1, 2, 3))] == [3]
    assert taken.missed == 0


def test_what_was_not_read_in_time_is_counted():
    taken = BeamOffs()
    taken.take(view(1))
    assert [one.number for one in taken.take(view(*range(4, 4 + KEPT_OFFS)))] == list(range(4, 4 + KEPT_OFFS))
    assert taken.missed == 2


def test_without_a_view_or_a_signal_there_is_nothing():
    taken = BeamOffs()
    assert taken.take(None) == []
    assert taken.take(replace(view(), beam_on=None)) == []


@pytest.mark.both_databases
def test_the_audit_has_a_row_for_each_hold_and_the_session_a_summary(client, session_id, running: FakeRunning):
    assert client.get(f"/api/v1/sessions/{session_id}").json()["summary"]["beam_off"] is None
    running.beam_on = BeamOnState(newest_offs=offs(1, 2))
    running.frame()
    eventually(lambda: len(audit_rows(client, "beam.off")) == 2)
    running.beam_on = BeamOnState(newest_offs=offs(1, 2, 3))
    running.frame()
    eventually(lambda: len(audit_rows(client, "beam.off")) == 3)
    rows = audit_rows(client, "beam.off")
    assert [row["detail"] for row in rows] == [
        {"number": number, "held_ns": number * 1_000_000_000, "off_ms": 40.0 + number} for number in (1, 2, 3)
    ]
    assert {row["session_id"] for row in rows} == {session_id}
    assert act(client, session_id, "stop").status_code == 200
    summary = client.get(f"/api/v1/sessions/{session_id}").json()["summary"]["beam_off"]
    assert summary == {"holds": 3, "median_ms": 42.0, "p95_ms": pytest.approx(42.9), "slowest_ms": 43.0}
