"""The audit chain: every change and refusal in it, nothing taken out, and every edit found."""

import sqlite3

import pytest
from hypothesis import given, strategies as st

from engine.core.gate_state import GateState, HoldReason
from service.storage import audit
from service.storage.audit import Event
from service.storage.audit.export import verify_export
from service.storage.database.engine import Database
from service.web.app import create_app
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import act, audit_rows, upload
from tests.support.waiting import eventually

pytestmark = pytest.mark.slow

TRIGGERS = ("audit_no_update", "audit_no_delete", "audit_only_next")


@pytest.fixture
def database(tmp_path):
    database = Database(tmp_path / "audit.db")
    database.migrate()
    with database.write() as db:
        for number in range(1, 8):
            audit.append(db, Event(actor="me", action="test", detail={"number": number, "text": "Grüße ☢"}))
    yield database
    database.close()


@pytest.fixture
def raw(database):
    connection = sqlite3.connect(database.path)
    yield connection
    connection.close()


def verified(database):
    with database.read() as db:
        return audit.verify(db)


def test_an_untouched_chain_holds(database):
    found = verified(database)
    assert (found.rows, found.first_broken_sequence) == (7, None)
    assert len(found.head_hash) == 64


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE audit SET actor = 'you' WHERE sequence = 3",
        "UPDATE audit SET hash = hash",
        "DELETE FROM audit WHERE sequence = 7",
        "DELETE FROM audit",
        "INSERT OR REPLACE INTO audit SELECT sequence, at, 'you', action, outcome, session_id, detail, previous_hash, "
        "hash FROM audit WHERE sequence = 3",
        "INSERT INTO audit SELECT 99, at, actor, action, outcome, session_id, detail, previous_hash, hash FROM audit "
        "WHERE sequence = 3",
    ],
)
def test_the_database_refuses_to_change_the_log(database, raw, statement):
    with pytest.raises(sqlite3.IntegrityError, match="audit log"):
        raw.execute(statement)
    raw.rollback()
    assert verified(database).rows == 7


@pytest.mark.parametrize("sequence", [1, 4, 7])
@pytest.mark.parametrize(
    "column", ["at", "actor", "action", "outcome", "session_id", "detail", "previous_hash", "hash"]
)
def test_an_edited_row_is_named(database, raw, sequence, column):
    for trigger in TRIGGERS:
        raw.execute(f"DROP TRIGGER {trigger}")
    raw.execute(f"UPDATE audit SET {column} = 'x' || substr({column} || 'yz', 2) WHERE sequence = ?", (sequence,))
    if column == "session_id":
        raw.execute("UPDATE audit SET session_id = 'somebody else' WHERE sequence = ?", (sequence,))
    raw.commit()
    assert verified(database).first_broken_sequence == sequence


def test_an_edited_row_with_a_new_seal_breaks_the_next_one(database, raw):
    for trigger in TRIGGERS:
        raw.execute(f"DROP TRIGGER {trigger}")
    with database.write() as db:
        row = db.get(audit.AuditRow, 3)
        row.actor = "you"
        row.hash = audit.seal(row)
    assert verified(database).first_broken_sequence == 4


@pytest.mark.parametrize(("removed", "broken"), [(1, 2), (4, 5), (6, 7)])
def test_a_removed_row_is_noticed_at_the_next_one(database, raw, removed, broken):
    raw.execute("DROP TRIGGER audit_no_delete")
    raw.execute("DELETE FROM audit WHERE sequence = ?", (removed,))
    raw.commit()
    found = verified(database)
    assert found.first_broken_sequence == broken
    assert found.detail == f"row {removed} is missing before row {broken}"


def test_two_rows_that_changed_places_are_noticed(database, raw):
    for trigger in TRIGGERS:
        raw.execute(f"DROP TRIGGER {trigger}")
    for old, new in ((3, -1), (4, 3), (-1, 4)):
        raw.execute("UPDATE audit SET sequence = ? WHERE sequence = ?", (new, old))
    raw.commit()
    assert verified(database).first_broken_sequence == 3


@given(st.dictionaries(st.text(max_size=8), st.none() | st.booleans() | st.integers() | st.text(max_size=8)))
def test_canonical_json_is_one_text_for_one_value(detail):
    turned = dict(reversed(detail.items()))
    assert audit.canonical_json(detail) == audit.canonical_json(turned)


def test_a_broken_chain_is_reported_over_http(client, settings):
    connection = sqlite3.connect(settings.data_dir / "tidegate.db")
    connection.execute("DROP TRIGGER audit_no_update")
    connection.execute("UPDATE audit SET actor = 'you' WHERE sequence = 1")
    connection.commit()
    connection.close()
    found = client.get("/api/v1/audit/verify").json()
    assert (found["is_intact"], found["first_broken_sequence"], found["breakage"]) == (False, 1, "changed")


def test_a_chain_is_walked_part_by_part_over_http(client, session_id):
    first = client.get("/api/v1/audit/verify", params={"limit": 2}).json()
    assert (first["is_intact"], first["is_complete"], first["rows"], first["checked_to"]) == (True, False, 2, 2)
    rest = client.get("/api/v1/audit/verify", params={"after": 2}).json()
    assert (rest["is_intact"], rest["is_complete"], rest["rows"]) == (True, True, 1)
    whole = client.get("/api/v1/audit/verify").json()
    assert (whole["rows"], whole["head_hash"]) == (3, rest["head_hash"])
    assert client.get("/api/v1/audit/verify", params={"after": 99}).status_code == 404


def test_only_one_walk_is_done_at_a_time(client):
    desk = client.app.state.services.audit
    with desk._walking:
        answer = client.get("/api/v1/audit/verify")
    assert (answer.status_code, answer.json()["code"]) == (409, "audit_busy")
    assert client.get("/api/v1/audit/verify").status_code == 200


@pytest.mark.parametrize("with_patients", [True, False])
def test_an_export_is_streamed_audited_and_verified_by_itself(client, session_id, with_patients):
    asked = {"with_patients": with_patients, "session_id": session_id}
    answer = client.get("/api/v1/audit/export", params=asked)
    assert answer.status_code == 200
    assert answer.headers["content-type"].partition(";")[0].endswith("ndjson")
    assert verify_export(answer.text.splitlines()).is_intact
    (row,) = audit_rows(client, "audit.export")
    assert (row["actor"], row["session_id"], row["detail"]["with_patients"]) == (
        "A. Therapist",
        session_id,
        with_patients,
    )


def test_an_export_of_an_unknown_session_is_refused(client):
    answer = client.get("/api/v1/audit/export", params={"session_id": "f" * 32})
    assert (answer.status_code, answer.json()["field"]) == (404, "session_id")


def test_exported_samples_are_audited(client, session_id, running):
    running.frame()
    act(client, session_id, "stop")
    assert client.get(f"/api/v1/sessions/{session_id}/samples").status_code == 200
    (row,) = audit_rows(client, "samples.export")
    assert (row["actor"], row["session_id"], row["detail"]) == ("A. Therapist", session_id, {"format": "csv"})


def test_a_whole_treatment_can_be_read_from_the_audit(client, session_id, running):
    running.frame()
    for action in ("reference", "arm", "disarm", "acknowledge", "models/retrain", "stop"):
        act(client, session_id, action)
    rows = audit_rows(client)
    body = [(row["action"], row["outcome"]) for row in rows if row["action"] != "gate.transition"]
    assert body == [
        ("service.start", "done"),
        ("calibration.upload", "done"),
        ("session.create", "done"),
        ("session.start", "done"),
        ("session.reference", "requested"),
        ("session.reference", "done"),
        ("session.arm", "requested"),
        ("session.arm", "done"),
        ("session.disarm", "done"),
        ("session.acknowledge", "requested"),
        ("session.acknowledge", "done"),
        ("model.retrain", "requested"),
        ("model.retrain", "done"),
        ("session.stop", "done"),
        ("session.close", "done"),
    ]
    assert [row["sequence"] for row in rows] == list(range(1, len(rows) + 1))
    assert client.get("/api/v1/audit/verify").json()["is_intact"]


def test_the_audit_states_loudly_that_the_beam_line_is_simulated(client, session_id, running):
    for action in ("session.create", "session.start"):
        assert "SIMULATED" in audit_rows(client, action)[0]["detail"]["beam_line"]
    assert audit_rows(client, "service.start")[0]["detail"]["is_simulated_beam"] is True


def test_a_transition_is_audited_with_its_person_and_its_times(client, session_id, running):
    running.transition(GateState.FAULT, HoldReason.WATCHDOG, operator="C. Nurse")
    eventually(lambda: audit_rows(client, "gate.transition"))
    (row,) = audit_rows(client, "gate.transition")
    assert (row["actor"], row["session_id"]) == ("C. Nurse", session_id)
    assert row["detail"] == {
        "from_state": "disarmed",
        "to_state": "fault",
        "reason": "watchdog",
        "operator": "C. Nurse",
        "detail": "test",
        "frame_index": 3,
        "captured_us": 100,
        "received_ns": 1_999_999_997,
        "decided_ns": 2_000_000_000,
        "asserted_ns": 2_000_000_003,
        "captured_ns": None,
        "latency_ms": None,
        "number": None,
        "armed_by": None,
    }


def test_the_audit_is_filtered_by_session_and_paged(client, session_id, calibration_text):
    act(client, session_id, "stop")
    upload(client, calibration_text)
    page = client.get("/api/v1/audit", params={"session_id": session_id}).json()
    assert [row["action"] for row in page["items"]] == ["session.stop", "session.create"]
    first = client.get("/api/v1/audit", params={"limit": 2}).json()
    rest = client.get("/api/v1/audit", params={"cursor": first["next_cursor"]}).json()
    assert [row["sequence"] for row in first["items"] + rest["items"]] == [5, 4, 3, 2, 1]
    assert rest["next_cursor"] is None


@pytest.mark.parametrize(
    ("name", "value"), [("session_id", "zzz"), ("cursor", "-1"), ("cursor", "9" * 40), ("limit", 0)]
)
def test_a_bad_question_to_the_audit_is_refused(client, name, value):
    answer = client.get("/api/v1/audit", params={name: value})
    assert (answer.status_code, answer.json()["field"]) == (422, name)


def test_an_audit_that_is_not_as_it_should_be_is_reported_by_the_readiness(client, settings, session_id):
    ready = client.get("/readyz").json()
    assert not [reason for reason in ready["not_ready"] if "audit" in reason]
    eventually(settings.anchor_file.exists)  # that of the start: the next comes with the session's
    settings.anchor_file.unlink()
    settings.anchor_file.mkdir()
    assert act(client, session_id, "start").status_code == 200
    eventually(lambda: "the audit's heads cannot be kept" in str(client.get("/readyz").json()["not_ready"]))
    (row,) = audit_rows(client, "audit.anchors_failed")
    assert row["outcome"] == "failed"


def test_a_log_that_was_cut_off_while_nothing_ran_is_reported_by_the_readiness(settings, engine):
    with PeopleClient(create_app(settings, lambda _settings: engine)):
        pass
    connection = sqlite3.connect(settings.data_dir / "tidegate.db")
    connection.execute("DROP TRIGGER audit_no_delete")
    connection.execute("DELETE FROM audit WHERE sequence > 1")
    connection.commit()
    connection.close()
    with PeopleClient(create_app(settings, lambda _settings: engine)) as client:
        assert "rows were cut off" in str(client.get("/readyz").json()["not_ready"])
        (row,) = audit_rows(client, "audit.broken")
        assert (row["actor"], row["outcome"]) == ("tidegate", "failed")
        assert client.get("/api/v1/audit/verify").json()["is_intact"] is False
