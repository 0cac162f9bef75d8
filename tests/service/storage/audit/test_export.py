"""What is exported can be read by others, and verified without the database."""

import json
from datetime import UTC, datetime, timedelta

import pytest

from service.storage import audit
from service.storage.audit import Breakage, Event
from service.storage.audit.export import ExportRequest, verify_export, write_export
from service.storage.database.tables import CalibrationRow, SessionRow

SESSION = "5" * 32
PATIENT = "P-UNMISTAKABLE-77"
FOR_NURSE = {"message": "no", "on_behalf_of": "A. Nurse"}
OF_PATIENT = {"detail": f"of {PATIENT}"}
NOW = datetime(2026, 11, 21, 12, tzinfo=UTC)


@pytest.fixture
def treated(database):
    with database.write() as db:
        db.add(CalibrationRow(id="c", sha256="c", camera="c", document="{}", uploaded_by="me", created_at=NOW))
        db.flush()
        about = {"patient_reference": PATIENT, "plan_id": "PLAN-9", "fraction_id": "FX-8"}
        row = {"status": "ended", "status_detail": "", "operator": "me", "source": "{}", "window": "{}"}
        db.add(SessionRow(id=SESSION, calibration_id="c", is_simulated_beam=True, created_at=NOW, **about, **row))
        db.flush()
        events = [
            Event(actor="tidegate", action="service.start", detail={"version": "1"}),
            Event(actor="A. Nurse", action="user.login", detail={"roles": ["therapist"], "way": "password"}),
            Event(actor="A. Nurse", action="session.create", session_id=SESSION, detail=about),
            Event(actor="key: plan", action="session.arm", outcome="refused", session_id=SESSION, detail=FOR_NURSE),
            Event(actor="tidegate", action="session.close", outcome="failed", session_id=SESSION, detail=OF_PATIENT),
            Event(actor="tidegate", action="audit.broken", outcome="failed", detail={"detail": "oh"}),
        ]
        for number, event in enumerate(events):
            audit.append(db, event, NOW + timedelta(minutes=number))
    return database


def exported(database, **asked):
    return "".join(write_export(database, ExportRequest(**asked))).splitlines()


def test_json_lines_hold_every_row_and_say_how_many(treated):
    lines = [json.loads(line) for line in exported(treated)]
    assert [line.get("sequence") for line in lines] == [*range(1, 14), None]
    assert lines[9]["detail"]["patient_reference"] == PATIENT
    assert lines[-1]["end"]["rows"] == 13


def test_a_whole_export_is_verified_by_itself(treated):
    found = verify_export(exported(treated))
    assert (found.is_intact, found.rows, found.notes) == (True, 13, ())


@pytest.mark.parametrize(
    "asked", [{"session_id": SESSION}, {"since": NOW + timedelta(minutes=2)}, {"until": NOW + timedelta(minutes=3)}]
)
def test_a_part_is_verified_as_far_as_it_goes(treated, asked):
    found = verify_export(exported(treated, **asked))
    assert found.is_intact
    assert 0 < found.rows < 13


def test_times_bound_a_part_from_the_first_moment_to_before_the_last(treated):
    lines = exported(treated, since=NOW, until=NOW + timedelta(minutes=2))
    assert [json.loads(line)["action"] for line in lines[:-1]] == ["service.start", "user.login"]


@pytest.mark.parametrize("line", [0, 5, 12])
@pytest.mark.parametrize("name", ["at", "actor", "action", "outcome", "session_id", "detail", "previous_hash", "hash"])
def test_a_changed_line_is_found(treated, line, name):
    lines = exported(treated)
    row = json.loads(lines[line])
    row[name] = {"x": 1} if name == "detail" else "x"
    lines[line] = json.dumps(row)
    assert verify_export(lines).first_broken_sequence == line + 1


def test_lines_left_out_cut_off_swapped_added_or_mistaken_are_found(treated):
    lines = exported(treated)
    assert verify_export(lines[:-1]).breakage is Breakage.CUT_OFF
    assert verify_export([*lines[:4], *lines[5:]]).breakage is Breakage.MISSING
    assert verify_export([*lines[:12], lines[13]]).breakage is Breakage.MISSING
    assert verify_export([lines[1], lines[0], *lines[2:]]).breakage is Breakage.REORDERED
    assert verify_export([*lines, lines[0]]).breakage is Breakage.INSERTED
    assert verify_export(["{}"]).breakage is Breakage.CHANGED
    assert verify_export(["nonsense"]).breakage is Breakage.CHANGED


def test_a_line_left_out_is_found_although_the_end_was_made_to_fit(treated):
    lines = exported(treated)
    end = json.loads(lines[-1])
    end["end"]["rows"] -= 1
    found = verify_export([*lines[:4], *lines[5:-1], json.dumps(end)])
    assert (found.breakage, found.detail) == (Breakage.MISSING, "rows are missing at 1 places of a whole export")


def test_a_detail_that_somebody_wrote_otherwise_is_exported_as_it_lies_there(treated, raw):
    raw.execute("UPDATE audit SET detail = '{ }' WHERE sequence = 2")
    raw.commit()
    assert verify_export(exported(treated)).first_broken_sequence == 2


def test_a_patient_is_named_only_where_asked(treated):
    plain = "".join(exported(treated, with_patients=False))
    assert not [word for word in (PATIENT, "PLAN-9", "FX-8") if word in plain]
    assert PATIENT in "".join(exported(treated))


@pytest.mark.parametrize(
    ("action", "detail"),
    [
        ("session.create", {"field": "model_id", "bound": "a model of P-OTHER-5"}),
        ("model.activate", {"message": "learned of P-OTHER-5"}),
        ("qa.start", {"patient_reference": "P-OTHER-5"}),
        ("qa.start", {"deeper": [{"plan_id": "P-OTHER-5"}]}),
        ("qa.start", {"field": "window.fraction_id", "value": "'P-OTHER-5'"}),
    ],
)
def test_a_refusal_before_there_is_a_session_reports_no_patient_either(treated, action, detail):
    with treated.write() as db:
        audit.append(db, Event(actor="me", action=action, outcome="refused", detail=detail))
    assert "P-OTHER-5" not in "".join(exported(treated, with_patients=False))
    assert "P-OTHER-5" in "".join(exported(treated))


def test_rows_without_their_detail_are_verified_as_far_as_they_tell(treated):
    plain = exported(treated, with_patients=False)
    found = verify_export(plain)
    assert found.is_intact
    assert found.notes[0].startswith("2 rows without their detail")
    row = json.loads(plain[9])
    assert "detail" not in row
    changed = [*plain[:9], json.dumps(row | {"previous_hash": "x"}), *plain[10:]]
    assert verify_export(changed).first_broken_sequence == 10


def test_what_is_added_while_it_is_written_is_left_alone(treated, monkeypatch):
    monkeypatch.setattr("service.storage.audit.export.PIECE_ROWS", 2)
    pieces = write_export(treated, ExportRequest())
    text = next(pieces)
    with treated.write() as db:
        audit.append(db, Event(actor="me", action="test"))
    lines = (text + "".join(pieces)).splitlines()
    assert len(lines) == 14
    assert verify_export(lines).is_intact
