"""An armed gate belongs to somebody who is there: whose log-in ends, by whatever way, has the beam held."""

from datetime import timedelta
from types import SimpleNamespace

import pytest
from sqlalchemy.exc import OperationalError

from engine.core.commands import Arm, HoldBeam, ReleaseBeam
from service.access import armed_operator
from service.access.accounts.people import Change
from service.access.armed_operator import ArmedOperator
from service.access.request.identity import Identity
from service.core.errors import EngineTimeoutError
from service.core.permissions import KEY_PERMISSIONS, Role
from service.engine_host.equipment import ArmedSession
from tests.support.service.api_calls import act, audit_rows
from tests.support.service.fake_engine import REFUSED
from tests.support.waiting import eventually

pytestmark = pytest.mark.slow

ARMS = "A. Therapist"


@pytest.fixture
def armed(client, session_id, running):
    client.app.state.armed_operator.close()  # looks when the test requests it
    client.headers_as("B. Physicist")
    assert act(client, session_id, "arm").status_code == 200
    running.frame()
    return running


def look(client):
    client.app.state.armed_operator.check()


def holds(running):
    return [command for command in running.commands if isinstance(command, HoldBeam)]


def test_while_the_person_who_armed_is_present_nothing_is_held(client, armed):
    look(client)
    assert holds(armed) == []


def log_out(client):
    assert client.post("/api/v1/logout", json={"operator": ARMS}).status_code == 204


def disable(client):
    client.desk.accounts.change(ARMS, Change(is_disabled=True), by="test")


def let_idle(client):
    store = client.desk.store
    now = store.now() + timedelta(hours=1)
    store.now = lambda: now


def take_the_role(client):
    client.desk.accounts.change(ARMS, Change(roles=frozenset({Role.VIEWER})), by="test")


@pytest.mark.parametrize("ends", [log_out, disable, let_idle, take_the_role])
def test_a_log_in_that_ends_by_itself_turns_nothing_on_and_has_the_beam_held_once(
    client,
    session_id,
    armed,
    ends,
):
    before = list(armed.commands)
    ends(client)
    assert armed.commands == before
    look(client)
    look(client)
    assert holds(armed) == [HoldBeam(operator="tidegate")]
    client.desk.store.now = type(client.desk.store)(None).now
    client.speaks_as = "B. Physicist"
    row = audit_rows(client, "session.hold")[-1]
    assert (row["actor"], row["outcome"], row["detail"]["armed_by"]) == ("tidegate", "done", ARMS)


def test_another_holds_stops_and_goes_on_where_one_s_log_in_has_ended(client, session_id, armed):
    log_out(client)
    look(client)
    assert act(client, session_id, "hold", operator="B. Physicist").status_code == 200
    assert act(client, session_id, "release", operator="B. Physicist").status_code == 200
    look(client)
    assert len(holds(armed)) == 2
    assert act(client, session_id, "stop", operator="B. Physicist").status_code == 200


def test_a_person_who_is_logged_in_elsewhere_is_there(client, armed):
    from tests.support.service.accounts import open_login

    open_login(client.desk.store, ARMS)
    log_out(client)
    look(client)
    assert holds(armed) == []


def test_a_gate_that_is_not_armed_is_not_held_over_a_log_in(client, session_id, armed):
    act(client, session_id, "disarm")
    armed.frame()
    log_out(client)
    look(client)
    assert holds(armed) == []


def test_a_machine_whose_key_is_revoked_is_not_there(client, session_id, armed):
    desk = client.desk
    made = desk.keys.create("planning", KEY_PERMISSIONS, desk.store.now() + timedelta(days=1), by="test")
    bearer = {"Authorization": f"Bearer {made.secret}"}
    client.speaks_as = None
    url = f"/api/v1/sessions/{session_id}/arm"
    answer = client.post(
        url, content=b'{"operator": "C. Nurse"} ', headers={**bearer, "Content-Type": "application/json"}
    )
    assert answer.status_code == 200, answer.text
    assert Arm(operator="key:planning", is_person=False) in armed.commands
    look(client)
    assert holds(armed) == []
    desk.keys.revoke(made.key.id, by="test")
    look(client)
    assert len(holds(armed)) == 1


def test_a_machine_of_the_identity_provider_is_there_until_its_newest_token_expires(client):
    authenticator, now = client.desk.authenticator, client.desk.store.now()
    ends = {"short": now + timedelta(minutes=5), "long": now + timedelta(minutes=9), "over": now - timedelta(seconds=1)}

    def identify(token):
        return Identity(kind="machine", name="machine:m", permissions=frozenset(), until=ends[token])

    authenticator.machine_verifier = SimpleNamespace(identify=identify)
    is_present = authenticator.is_present
    assert not any(map(is_present, ["machine:m", "unknown", "key:unknown", "m"]))
    authenticator.identify({"authorization": "Bearer over"})
    assert not is_present("machine:m")
    authenticator.identify({"authorization": "Bearer long"})
    authenticator.identify({"authorization": "Bearer short"})  # an older token that is still sent shortens nothing
    assert is_present("machine:m")
    client.desk.store.now = lambda: ends["short"]
    assert is_present("machine:m")
    client.desk.store.now = lambda: ends["long"]
    assert not is_present("machine:m")


def test_the_look_is_every_second_and_goes_on_after_a_failure():
    asked = []

    def is_present(_identity):
        asked.append(1)
        raise OSError

    looks = ArmedOperator(is_present=is_present, armed=lambda: ArmedSession("s", "x"), hold=lambda *_: None)
    assert armed_operator.INTERVAL_S <= 1.0
    looks.start()
    eventually(lambda: len(asked) >= 2)
    looks.close()


def fail_to_write(client, monkeypatch, action):
    """The database goes between what the engine did and the row that says so."""
    log = client.app.state.services.runner._log
    write = log.write

    def refuse(event):
        if (event.action, event.outcome) == (action, "done"):
            raise OperationalError("INSERT", {}, OSError("locked"))
        write(event)

    monkeypatch.setattr(log, "write", refuse)


def test_the_arming_person_is_responsible_though_the_audit_row_is_missing(client, session_id, running, monkeypatch):
    client.app.state.armed_operator.close()
    client.headers_as("B. Physicist")
    fail_to_write(client, monkeypatch, "session.arm")
    assert act(client, session_id, "arm").status_code == 503
    running.frame()
    log_out(client)
    look(client)
    assert holds(running) == [HoldBeam(operator="tidegate")]


def test_the_releasing_person_is_responsible_though_the_audit_row_is_missing(client, session_id, armed, monkeypatch):
    act(client, session_id, "hold")
    fail_to_write(client, monkeypatch, "session.release")
    assert act(client, session_id, "release", operator="B. Physicist").status_code == 503
    log_out(client)
    look(client)
    assert holds(armed) == [HoldBeam(operator=ARMS)]


def test_a_person_whose_arm_timed_out_is_responsible_if_the_gate_is_armed(client, session_id, running):
    client.app.state.armed_operator.close()
    client.headers_as("B. Physicist")
    running.is_silent = True
    assert act(client, session_id, "arm").json()["code"] == "engine_timeout"
    log_out(client)
    look(client)  # the engine has not come to it
    running.is_silent = False
    running.submit(Arm(operator=ARMS))  # and does: it was taken a moment before it was taken back
    running.frame()
    look(client)
    assert holds(running) == [HoldBeam(operator="tidegate")]


def test_a_log_in_that_ends_before_a_frame_shows_the_gate_armed_has_it_held_then(client, session_id, running):
    client.app.state.armed_operator.close()
    client.headers_as("B. Physicist")
    assert act(client, session_id, "arm").status_code == 200
    log_out(client)
    look(client)
    running.frame()
    look(client)
    assert holds(running) == [HoldBeam(operator="tidegate")]


def test_whose_arming_is_refused_does_not_answer_for_another_one_s_gate(client, session_id, armed):
    armed.refuse_with = REFUSED
    assert act(client, session_id, "arm", operator="B. Physicist").status_code == 409
    armed.refuse_with = None
    log_out(client)
    look(client)
    assert holds(armed) == [HoldBeam(operator="tidegate")]


def test_a_hold_that_fails_is_tried_again_at_the_next_look():
    tried = []

    def hold(session_id, _identity):
        tried.append(session_id)
        if len(tried) == 1:
            raise EngineTimeoutError("not in time")

    looks = ArmedOperator(is_present=lambda _name: False, armed=lambda: ArmedSession("s", "x"), hold=hold)
    with pytest.raises(EngineTimeoutError):
        looks.check()
    looks.check()
    assert tried == ["s", "s"]


def test_who_releases_answers_for_the_gate_and_a_program_takes_over_from_no_one(client, session_id, armed):
    act(client, session_id, "hold", operator="B. Physicist")
    assert client.get(f"/api/v1/sessions/{session_id}").json()["gate"]["armed_by"] == ARMS
    made = client.desk.keys.create("planning", KEY_PERMISSIONS, client.desk.store.now() + timedelta(days=1), by="test")
    client.speaks_as = None
    bearer = {"Authorization": f"Bearer {made.secret}"}
    url = f"/api/v1/sessions/{session_id}/release"
    assert client.post(url, json={"operator": "C. Nurse"}, headers=bearer).status_code == 200
    assert armed.commands[-1] == ReleaseBeam(operator="key:planning", is_person=False)
    client.speaks_as = ARMS
    assert client.get(f"/api/v1/sessions/{session_id}").json()["gate"]["armed_by"] == ARMS
    act(client, session_id, "hold", operator="B. Physicist")
    assert act(client, session_id, "release", operator="B. Physicist").status_code == 200
    assert armed.commands[-1] == ReleaseBeam(operator="B. Physicist", is_person=True)
    assert client.get(f"/api/v1/sessions/{session_id}").json()["gate"]["armed_by"] == "B. Physicist"


def test_a_hold_over_a_log_in_that_a_program_releases_is_held_again(client, session_id, armed):
    log_out(client)
    look(client)
    armed.submit(ReleaseBeam(operator="key:planning", is_person=False))
    look(client)
    assert holds(armed) == [HoldBeam(operator="tidegate")] * 2
