"""What is exported can be read by others, and verified without the database."""

import json
from datetime import UTC, datetime, timedelta

import pytest
from fhirclient.models.auditevent import AuditEvent

from service.storage import audit
from service.storage.audit import Breakage, Event
from service.storage.audit.formats.codes import FAMILIES, MEANINGS
from service.storage.audit.formats.export import ExportFormat, ExportRequest, verify_export, write_export
from service.storage.audit.formats.fhir import ACTIONS, DCM, PATIENTS, SEAL, SESSIONS
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
    request = ExportRequest(**{"format": ExportFormat.JSONL, **asked})
    return "".join(write_export(database, request, site="Ward 7")).splitlines()


def resources(database, **asked):
    return [json.loads(line) for line in exported(database, format=ExportFormat.FHIR, **asked)]


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


def test_fhir_resources_are_read_by_others(treated):
    found = [AuditEvent(resource) for resource in resources(treated)]
    assert len(found) == 13
    start, login, create, arm, close, broken = found[7:]
    assert (start.type.system, start.type.code, start.subtype[0].code) == (DCM, "110100", "110120")
    assert (login.type.code, login.subtype[0].code, login.action) == ("110114", "110122", "E")
    assert (create.type.code, create.action, create.outcome) == ("110111", "C", "0")
    assert [one.outcome for one in (arm, close, broken)] == ["4", "8", "12"]
    assert [one.subtype[-1].code for one in found[7:9]] == ["service.start", "user.login"]
    assert {one.subtype[-1].system for one in found} == {ACTIONS}


def test_an_agent_is_a_person_a_machine_for_a_person_or_ourselves(treated):
    found = [AuditEvent(resource) for resource in resources(treated)]
    start, login, _, arm, *_ = found[7:]
    assert (start.agent[0].requestor, start.agent[0].type.coding[0].code) == (False, "110150")
    assert (login.agent[0].who.identifier.value, login.agent[0].requestor) == ("A. Nurse", True)
    assert login.agent[0].role[0].coding[0].code == "therapist"
    assert [agent.name for agent in arm.agent] == ["key: plan", "A. Nurse"]
    assert [agent.requestor for agent in arm.agent] == [True, False]


def test_what_fhir_requires_is_there_and_times_are_instants(treated):
    for resource in resources(treated):
        event = AuditEvent(resource)
        assert event.source.observer.identifier.value == "Ward 7"
        assert event.source.type[0].code == "4"
        assert event.recorded.date.tzinfo is not None
        assert event.agent
        assert event.type.display


def test_a_session_is_named_and_its_patient_only_where_asked(treated):
    plain = [json.dumps(resource) for resource in resources(treated)]
    assert not [line for line in plain if PATIENT in line or "PLAN-9" in line]
    (arm,) = [AuditEvent(one) for one in resources(treated) if one["subtype"][-1]["code"] == "session.arm"]
    assert [entity.what.identifier.system for entity in arm.entity] == [SESSIONS]
    (asked,) = [
        AuditEvent(one) for one in resources(treated, with_patients=True) if one["subtype"][-1]["code"] == "session.arm"
    ]
    assert [entity.what.identifier.system for entity in asked.entity] == [SESSIONS, PATIENTS]
    assert asked.entity[1].what.identifier.value == PATIENT


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
def test_a_refusal_before_there_is_a_session_tells_of_no_patient_either(treated, action, detail):
    with treated.write() as db:
        audit.append(db, Event(actor="me", action=action, outcome="refused", detail=detail))
    assert "P-OTHER-5" not in "".join(exported(treated, format=ExportFormat.FHIR))
    assert "P-OTHER-5" in "".join(exported(treated, format=ExportFormat.FHIR, with_patients=True))


def test_fhir_resources_are_verified_by_themselves_as_far_as_they_tell(treated):
    whole = [json.dumps(resource) for resource in resources(treated, with_patients=True)]
    assert (verify_export(whole).is_intact, verify_export(whole).notes) == (True, ())
    plain = [json.dumps(resource) for resource in resources(treated)]
    found = verify_export(plain)
    assert found.is_intact
    assert found.notes[0].startswith("2 rows without their detail")
    assert verify_export([*plain[:3], *plain[4:]]).notes[0] == "1 places at which rows were left out"
    changed = resources(treated)
    seal = next(one for one in changed[8]["extension"] if one["url"] == SEAL)
    next(part for part in seal["extension"] if part["url"] == "actor")["valueString"] = "you"
    assert verify_export(json.dumps(one) for one in changed).first_broken_sequence == 9


def test_what_is_added_while_it_is_written_is_left_alone(treated, monkeypatch):
    monkeypatch.setattr("service.storage.audit.formats.export.PIECE_ROWS", 2)
    pieces = write_export(treated, ExportRequest(format=ExportFormat.JSONL), site="")
    text = next(pieces)
    with treated.write() as db:
        audit.append(db, Event(actor="me", action="test"))
    lines = (text + "".join(pieces)).splitlines()
    assert len(lines) == 14
    assert verify_export(lines).is_intact


def test_every_meaning_has_a_code_of_six_digits_and_a_letter():
    for meaning in [*MEANINGS.values(), *FAMILIES.values()]:
        assert len(meaning.event.value) == 6
        assert meaning.letter in "CRUDE"
