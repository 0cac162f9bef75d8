"""The whole service on a real line: a session over HTTP turns a receiver in another process on, and off at its end."""

import pytest

from service.core.settings.settings import LIMIT_DEFAULTS, Settings
from service.web.app import create_app
from tests.support.beam import modbus_server
from tests.support.beam.receivers import TIMES, receiver
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import act, audit_rows, make_session_body, upload
from tests.support.service.clinical_site import OBLIGATORY
from tests.support.service.real_engine import PATIENT_LIMITS, HurriedEngine, arm_when_ready, detail_of, open_session
from tests.support.waiting import eventually

pytestmark = pytest.mark.waiting

FILM = {"kind": "recording", "path": "recording.oni", "player": "reader"}
TRIES = 6
DEFAULTS = {name: LIMIT_DEFAULTS[name] for name in PATIENT_LIMITS}


@pytest.fixture
def far():
    with receiver("tcp") as held:
        yield held


@pytest.fixture
def site():
    return {"recordings_may_gate": True}


@pytest.fixture
def client(tmp_path, regular_volunteer, far, site):
    settings = Settings(
        data_dir=tmp_path / "data",
        recordings_dirs=(regular_volunteer,),
        allowed_hosts=("testserver",),
        beam_line="modbus-tcp",
        beam_modbus_host="127.0.0.1",
        beam_modbus_port=int(far.where),
        beam_modbus_unit=modbus_server.UNIT,
        beam_modbus_permit_coil=modbus_server.COIL,
        beam_modbus_heartbeat_register=modbus_server.REGISTER,
        beam_modbus_readback_input=modbus_server.INPUT,
        beam_answer_ms=TIMES.answer_ms,
        beam_settle_ms=TIMES.settle_ms,
        **PATIENT_LIMITS | site,
    )
    with PeopleClient(create_app(settings, HurriedEngine)) as held:
        yield held


def _started(client, calibration):
    """A session that runs; another one where its receiver answered late when it was opened, on a busy machine."""
    for _ in range(TRIES):
        session_id = open_session(client, calibration, source=FILM)
        answer = act(client, session_id, "start")
        if answer.status_code == 200 and answer.json()["status"] == "running":
            return session_id
    pytest.fail(f"no session starts: {answer.text}")


def test_a_session_turns_a_real_receiver_on_and_leaves_it_off(client, far, regular_volunteer):
    session_id = _started(client, (regular_volunteer / "calibration.json").read_bytes())
    assert detail_of(client, session_id)["is_simulated_beam"] is False
    assert far.seen == []
    while not far.seen:
        arm_when_ready(client, session_id)
        eventually(lambda: far.seen or detail_of(client, session_id)["gate"]["state"] == "fault", within_s=30.0)
    act(client, session_id, "stop")
    eventually(lambda: detail_of(client, session_id)["status"] != "running", within_s=30.0)
    eventually(lambda: far.seen[-1][0] == "off", within_s=10.0)
    assert far.seen[0][0] == "on"
    assert audit_rows(client, "service.start")[0]["detail"]["is_simulated_beam"] is False


def test_a_session_on_a_receiver_that_is_gone_does_not_start_and_states_why(client, far, regular_volunteer):
    far.process.kill()
    far.process.wait()
    session_id = open_session(client, (regular_volunteer / "calibration.json").read_bytes(), source=FILM)
    answer = act(client, session_id, "start")
    assert answer.status_code >= 400
    assert "does not answer" in answer.text


@pytest.mark.parametrize(
    "site",
    [{}, {"mode": "clinical", "hardware_dead_man": True, **OBLIGATORY, **DEFAULTS}],
    ids=["research", "clinical"],
)
def test_no_recording_gates_a_real_line_unless_the_site_states_it(client, far, regular_volunteer):
    calibration_id = upload(client, (regular_volunteer / "calibration.json").read_bytes()).json()["id"]
    answer = client.post("/api/v1/sessions", json=make_session_body(calibration_id) | {"source": FILM})
    assert (answer.status_code, answer.json()["field"]) == (422, "source.kind")
    assert "TIDEGATE_RECORDINGS_MAY_GATE" in answer.json()["bound"]
    assert client.get("/api/v1/sessions").json()["items"] == []
    assert far.seen == []


@pytest.mark.parametrize("site", [{}])
def test_a_recording_that_was_allowed_when_its_session_was_made_is_refused_when_it_starts(
    client, far, tmp_path, regular_volunteer, site
):
    earlier = Settings(data_dir=tmp_path / "data", recordings_dirs=(regular_volunteer,), allowed_hosts=("testserver",))
    with PeopleClient(create_app(earlier, HurriedEngine)) as before:
        session_id = open_session(before, (regular_volunteer / "calibration.json").read_bytes(), source=FILM)
    answer = act(client, session_id, "start")
    assert (answer.status_code, answer.json()["field"]) == (422, "source.kind")
    assert detail_of(client, session_id)["status"] == "failed"
    assert far.seen == []


def test_a_recording_that_gates_a_real_line_is_stated_loudly_in_the_audit(client, regular_volunteer):
    session_id = _started(client, (regular_volunteer / "calibration.json").read_bytes())
    assert "REAL beam line" in detail_of(client, session_id)["source_warning"]
    act(client, session_id, "stop")
    for action in ("session.create", "session.start"):
        warnings = [row["detail"]["source_warning"] for row in audit_rows(client, action)]
        assert warnings
        assert all(one.startswith("RECORDING") and "REAL beam line (modbus-tcp)" in one for one in warnings)


@pytest.mark.parametrize("site", [{"recordings_may_gate": True, "beam_on_input": modbus_server.BEAM_ON}])
def test_a_beam_that_stays_on_after_a_hold_is_shown_as_a_fault_and_audited(client, far, regular_volunteer):
    session_id = _started(client, (regular_volunteer / "calibration.json").read_bytes())

    def shown():
        return detail_of(client, session_id)["gate"]

    for _ in range(TRIES):
        arm_when_ready(client, session_id)
        eventually(lambda: far.is_on or shown()["state"] == "fault", within_s=30.0)
        far.spoil("beam on")
        act(client, session_id, "hold")
        eventually(lambda: shown()["state"] == "fault", within_s=30.0)
        if shown()["hold_reason"] == "beam_without_permit":
            break
        far.spoil("well")  # a busy machine's own fault came first
        act(client, session_id, "release")
        act(client, session_id, "acknowledge")
    assert shown()["hold_reason"] == "beam_without_permit"
    assert "the accelerator reports beam on" in shown()["hold_detail"]
    assert "tidegate_accelerator_beam_on 1.0" in client.get("/metrics").text
    eventually(lambda: [one["code"] for one in detail_of(client, session_id)["alarms"]] == ["beam_without_permit"])
    assert act(client, session_id, "acknowledge").status_code == 200
    eventually(lambda: shown()["hold_reason"] == "beam_without_permit", within_s=30.0)
    eventually(lambda: audit_rows(client, "alarm.acknowledge"))
    (again,) = detail_of(client, session_id)["alarms"]
    assert (again["code"], again["priority"], again["acknowledged_by"]) == ("beam_without_permit", "high", None)
    act(client, session_id, "stop")
    eventually(lambda: detail_of(client, session_id)["status"] != "running", within_s=30.0)
    reasons = [row["detail"].get("reason") for row in audit_rows(client, "gate.transition")]
    assert "beam_without_permit" in reasons


@pytest.mark.parametrize("site", [{"recordings_may_gate": True, "beam_on_input": modbus_server.BEAM_ON}])
def test_each_hold_of_a_beam_that_was_on_is_timed_in_the_audit_and_in_the_summary(client, far, regular_volunteer):
    session_id = _started(client, (regular_volunteer / "calibration.json").read_bytes())
    for _ in range(TRIES):
        arm_when_ready(client, session_id)
        eventually(lambda: far.is_on or detail_of(client, session_id)["gate"]["state"] == "fault", within_s=30.0)
        act(client, session_id, "disarm")
        act(client, session_id, "acknowledge")  # a busy machine's own fault
        if audit_rows(client, "beam.off"):
            break
    eventually(lambda: audit_rows(client, "beam.off"), within_s=30.0)
    act(client, session_id, "stop")
    eventually(lambda: detail_of(client, session_id)["status"] != "running", within_s=30.0)
    rows = audit_rows(client, "beam.off")
    assert [row["detail"]["number"] for row in rows] == list(range(1, len(rows) + 1))
    assert all(row["detail"]["off_ms"] > 0.0 for row in rows)
    held_ns = [row["detail"]["asserted_ns"] for row in audit_rows(client, "gate.transition")]
    assert all(min(abs(row["detail"]["held_ns"] - at) for at in held_ns) < 1_000_000_000 for row in rows)
    summary = detail_of(client, session_id)["summary"]["beam_off"]
    assert summary["holds"] == len(rows)
    assert summary["slowest_ms"] == pytest.approx(max(row["detail"]["off_ms"] for row in rows), abs=0.001)


@pytest.mark.parametrize("site", [{"recordings_may_gate": True, "beam_modbus_expected_coil": modbus_server.EXPECTED}])
def test_a_gate_is_expected_only_while_a_session_runs(client, far, regular_volunteer):
    calibration = (regular_volunteer / "calibration.json").read_bytes()
    assert far.gate == []
    session_id = _started(client, calibration)
    eventually(lambda: far.gate == [["expected", "command"]])
    act(client, session_id, "stop")
    eventually(lambda: far.gate[1:] == [["unexpected", "command"]], within_s=30.0)
