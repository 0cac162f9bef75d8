"""Alarms through HTTP: the session lists them, a person acknowledges them, the audit and the stream tell of it."""

import json
from pathlib import Path

import pytest
from sqlalchemy.exc import OperationalError

from engine.beam.beam_on import BeamOnState
from engine.core.commands import Acknowledge
from engine.core.errors import CommandRefusedError
from engine.core.gate_state import GateState, HoldReason
from service.sessions.alarms.watch import AlarmRecorder
from tests.support.contract.schemas import Schema
from tests.support.repository import ROOT
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import audit_rows
from tests.support.service.fake_engine import FakeRunning
from tests.support.waiting import eventually

pytestmark = pytest.mark.both_databases
URL = "/api/v1/sessions"
SCHEMA = Schema(json.loads((Path(ROOT) / "openapi" / "live.schema.json").read_text()))


def alarms_of(client: PeopleClient, session_id: str) -> list[dict]:
    return client.get(f"{URL}/{session_id}").json()["alarms"]


def shown(client: PeopleClient, session_id: str, *codes: str) -> list[dict]:
    """Wait until the session shows these alarms, and return them."""
    eventually(lambda: [alarm["code"] for alarm in alarms_of(client, session_id)] == list(codes))
    return alarms_of(client, session_id)


def acknowledge(client: PeopleClient, session_id: str, *numbers: int):
    body = {"operator": "A. Therapist", "alarms": list(numbers)} if numbers else {"operator": "A. Therapist"}
    return client.post(f"{URL}/{session_id}/acknowledge", json=body)


def audited(client: PeopleClient, session_id: str) -> list[tuple[str, str, str]]:
    rows = [row for row in audit_rows(client) if row["action"].startswith("alarm.")]
    assert all(row["session_id"] == session_id for row in rows)
    return [(row["action"], row["detail"]["code"], row["actor"]) for row in rows]


def test_a_fault_is_an_alarm_of_the_session_until_a_person_acknowledges_it(client, session_id, running: FakeRunning):
    running.fault(HoldReason.SOURCE_LOST)
    (alarm,) = shown(client, session_id, "source_lost")
    assert (alarm["priority"], alarm["text"], alarm["latches"]) == ("medium", "The camera is disconnected", True)
    assert (alarm["acknowledged_by"], alarm["session_id"]) == (None, session_id)
    answer = acknowledge(client, session_id)
    assert answer.status_code == 200
    assert answer.json()["alarms"] == []
    assert [type(command) for command in running.commands] == [Acknowledge]
    eventually(lambda: len(audited(client, session_id)) == 3)
    assert audited(client, session_id) == [
        ("alarm.begin", "source_lost", "tidegate"),
        ("alarm.acknowledge", "source_lost", "A. Therapist"),
        ("alarm.end", "source_lost", "tidegate"),
    ]
    row = next(row for row in audit_rows(client) if row["action"] == "alarm.acknowledge")
    assert row["detail"]["acknowledged_by"] == "A. Therapist"
    assert row["detail"]["alarm"] == alarm["number"]


def test_an_alarm_that_is_no_fault_is_acknowledged_without_a_command_to_the_gate(client, session_id, running):
    running.gate, running.beam_on = GateState.BEAM_ON, BeamOnState(is_absent=True)
    running.frame()
    (alarm,) = shown(client, session_id, "permit_without_beam")
    answer = acknowledge(client, session_id, alarm["number"])
    assert answer.status_code == 200
    (known,) = answer.json()["alarms"]
    assert known["acknowledged_by"] == "A. Therapist"
    assert known["acknowledged_at"] >= known["since"]
    assert running.commands == []
    row = audit_rows(client, "session.acknowledge")[-1]
    assert (row["outcome"], row["detail"]["alarms"]) == ("done", [alarm["number"]])
    running.beam_on = None
    running.frame()
    shown(client, session_id)


def test_the_numbers_say_which_alarms_are_meant_and_the_fault_is_not_acknowledged_with_another(
    client, session_id, running
):
    running.beam_on = BeamOnState(is_on=True, violation="beam on 300 ms after the permit ended")
    running.fault(HoldReason.SOURCE_LOST)
    beam, camera = shown(client, session_id, "beam_without_permit", "source_lost")
    running.beam_on = None
    running.frame()
    answer = acknowledge(client, session_id, beam["number"])
    assert [alarm["code"] for alarm in answer.json()["alarms"]] == ["source_lost"]
    assert running.commands == []
    assert answer.json()["gate"]["state"] == "fault"
    assert acknowledge(client, session_id, camera["number"]).json()["alarms"] == []
    assert [type(command) for command in running.commands] == [Acknowledge]


def test_a_beam_that_is_still_on_without_a_permit_is_a_new_alarm_after_its_acknowledgement(client, session_id, running):
    running.beam_on = BeamOnState(is_on=True, violation="beam on 300 ms after the permit ended")
    running.fault(HoldReason.BEAM_WITHOUT_PERMIT)
    (first,) = shown(client, session_id, "beam_without_permit")
    (again,) = acknowledge(client, session_id).json()["alarms"]
    assert (again["code"], again["priority"]) == ("beam_without_permit", "high")
    assert again["number"] > first["number"]
    assert again["acknowledged_by"] is None


def test_what_the_engine_refuses_leaves_the_alarm_unacknowledged(client, session_id, running):
    running.fault(HoldReason.DISK_LOW)
    shown(client, session_id, "disk_low")
    running.refuse_with = CommandRefusedError("the fault persists")
    assert acknowledge(client, session_id).status_code == 409
    (alarm,) = alarms_of(client, session_id)
    assert alarm["acknowledged_by"] is None


def test_an_alarm_that_is_not_active_cannot_be_acknowledged(client, session_id, running):
    running.frame()
    answer = acknowledge(client, session_id, 77)
    assert (answer.status_code, answer.json()["code"]) == (409, "command_refused")
    assert audit_rows(client)[-1]["outcome"] == "refused"


@pytest.mark.parametrize("alarms", [[], [0], [1.5], ["1"], list(range(1, 70)), 3])
def test_the_numbers_are_bounded(client, session_id, running, alarms):
    body = {"operator": "A. Therapist", "alarms": alarms}
    assert client.post(f"{URL}/{session_id}/acknowledge", json=body).status_code == 422


def test_a_latched_alarm_outlives_its_session_until_it_is_acknowledged(client, session_id, running):
    running.fault(HoldReason.ENGINE_FAILED)
    running.end(error="broken")
    eventually(lambda: client.get(f"{URL}/{session_id}").json()["status"] == "failed")
    (alarm,) = shown(client, session_id, "engine_failed")
    assert acknowledge(client, session_id, alarm["number"]).status_code == 200
    assert alarms_of(client, session_id) == []
    assert acknowledge(client, session_id).json()["code"] == "session_state"


def test_a_fault_that_ends_its_session_at_once_is_an_alarm_too(client, session_id, running):
    client.app.state.alarm_watch.close()  # nothing has looked before the session is over
    running.fault(HoldReason.ENGINE_FAILED)
    running.end(error="broken")
    eventually(lambda: client.get(f"{URL}/{session_id}").json()["status"] == "failed")
    shown(client, session_id, "engine_failed")


def test_a_hold_of_a_disarmed_gate_and_normal_gating_are_no_alarms(client, session_id, running):
    for gate, reason in ((GateState.DISARMED, HoldReason.PATIENT_SHIFTED), (GateState.HOLD, HoldReason.OUTSIDE_WINDOW)):
        running.gate, running.reason = gate, reason
        running.frame()
        client.app.state.alarm_watch.look()
        assert alarms_of(client, session_id) == []


def test_the_stream_reports_the_alarm_in_its_own_schema(client, session_id, running):
    running.frame()
    with client.websocket_connect("/api/v1/live") as socket:
        assert socket.receive_json()["type"] == "hello"
        running.fault(HoldReason.CLOCK_JUMPED)
        message = socket.receive_json()
        while message["type"] != "alarms":
            message = socket.receive_json()
    SCHEMA.validate(message)
    assert message["event"]["kind"] == "begin"
    assert [alarm["code"] for alarm in message["active"]] == ["clock_jumped"]


def test_events_that_the_database_does_not_take_are_written_when_it_does(client, session_id, running, monkeypatch):
    watch, writes = client.app.state.alarm_watch, []
    recorder = AlarmRecorder(watch.board, watch._recorder._writer._database)
    watch.close()  # the test writes itself
    running.fault(HoldReason.SOURCE_LOST)
    watch.look()
    real = recorder._append

    def broken(db):
        writes.append(db)
        raise OperationalError("insert", {}, Exception("locked"))

    monkeypatch.setattr(recorder, "_append", broken)
    with pytest.raises(OperationalError):
        recorder.write()
    acknowledge(client, session_id)
    monkeypatch.setattr(recorder, "_append", real)
    recorder.write()
    recorder.write()
    recorder.write()
    assert [action for action, _, _ in audited(client, session_id)] == ["alarm.begin", "alarm.acknowledge", "alarm.end"]
