"""What a fraction was armed and signed with goes on over sessions, programs, restarts; however its name is typed."""

import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace

import pytest

from engine.core.fraction_arming import FractionArming, PlacedCondition
from service.web.app import create_app
from tests.support.database.migrated import with_tables
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import act, audit_rows, make_session_body, upload
from tests.support.service.fake_engine import FakeEngine

PLACED = (PlacedCondition("AmplitudeWindow whole", -1.0, 3.0, -1.0, 3.0, "mm"),)
SIGNED = FractionArming(
    first=PLACED, armed_by="A. Therapist", signed=PLACED, signed_by="B. Therapist", signed_for="A. Therapist"
)
ALIKE = {
    "the same": {},
    "trailing spaces": {"plan_id": "PLAN-1 ", "fraction_id": " FX-1", "patient_reference": "P-0001  "},
    "double spaces": {"patient_reference": "P-0001"},
    "another case": {"plan_id": "plan-1", "fraction_id": "fx-1", "patient_reference": "p-0001"},
    "full width": {"plan_id": "ＰＬＡＮ-1"},  # noqa: RUF001 - compatibility characters are what is tried
    "Cyrillic letters": {"plan_id": "РLАN-1", "patient_reference": "Р-0001"},  # noqa: RUF001
}


@pytest.fixture
def body(session_body):
    return {**session_body, "patient_reference": "P-0001", "plan_id": "PLAN-1", "fraction_id": "FX-1"}


def begun(client, engine, body):
    """Create and start a session; return its id and what its engine was made with."""
    created = client.post("/api/v1/sessions", json=body)
    assert created.status_code == 201, created.text
    session_id = created.json()["id"]
    assert act(client, session_id, "start").status_code == 200
    return session_id, engine.running.plan


def armed_and_stopped(client, engine, body):
    session_id, plan = begun(client, engine, body)
    engine.running.fraction_arming = SIGNED
    engine.running.frame()
    assert act(client, session_id, "stop").status_code == 200
    return session_id, plan


@pytest.mark.parametrize("kind", ALIKE)
def test_a_further_session_of_the_fraction_begins_with_what_was_signed(client, engine, body, kind):
    first, plan = armed_and_stopped(client, engine, body)
    assert plan.fraction_arming is None
    second, plan = begun(client, engine, {**body, **ALIKE[kind]})
    assert plan.fraction_arming == SIGNED
    assert plan.patient_reference == "P-0001"
    shown = client.get(f"/api/v1/sessions/{second}").json()
    assert [shown[name] for name in ("patient_reference", "plan_id", "fraction_id")] == ["P-0001", "PLAN-1", "FX-1"]
    assert audit_rows(client, "session.start")[-1]["detail"]["arming_of_session"] == first


@pytest.mark.parametrize("other", [{"fraction_id": "FX-2"}, {"plan_id": "PLAN-2"}, {"patient_reference": "P-0002"}])
def test_another_fraction_plan_or_patient_begins_anew(client, engine, body, other):
    armed_and_stopped(client, engine, body)
    assert begun(client, engine, {**body, **other})[1].fraction_arming is None


def test_a_session_that_only_confirmed_a_reference_is_no_arming(client, engine, body):
    session_id, _ = begun(client, engine, body)
    engine.running.frame()
    act(client, session_id, "stop")
    assert begun(client, engine, body)[1].fraction_arming is None


def test_an_unsigned_arming_of_a_third_session_takes_the_signature_of_the_first_over(client, engine, body):
    armed_and_stopped(client, engine, body)
    session_id, _ = begun(client, engine, body)
    wider = (PLACED[0]._replace(upper=9.0),)
    engine.running.fraction_arming = replace(SIGNED, first=wider)
    act(client, session_id, "stop")
    assert begun(client, engine, body)[1].fraction_arming == replace(SIGNED, first=wider)


def test_the_last_arming_is_the_last_by_the_audit_though_the_clock_was_set_back(client, engine, settings, body):
    armed_and_stopped(client, engine, body)
    second, _ = begun(client, engine, body)
    narrower = replace(SIGNED, signed=(PLACED[0]._replace(upper=PLACED[0].upper - 1.0),))
    engine.running.fraction_arming = narrower
    act(client, second, "stop")
    with closing(sqlite3.connect(settings.database_place)) as connection, connection:
        connection.execute("UPDATE sessions SET created_at = '2001-01-01T00:00:00.000000Z' WHERE id = ?", (second,))
    assert begun(client, engine, body)[1].fraction_arming == narrower


def test_it_survives_a_restart_and_is_gone_with_a_database_of_before(
    settings, migrated_file, calibration_text, tmp_path
):
    """A database that was restored from before the arming asks for the signature again."""
    names = {"patient_reference": "P-0001", "plan_id": "PLAN-1", "fraction_id": "FX-1"}
    settings = with_tables(settings, migrated_file)
    before = tmp_path / "before.db"

    def served(doing):
        engine = FakeEngine()
        with PeopleClient(create_app(settings, lambda _settings: engine)) as client:
            calibrations = client.get("/api/v1/calibrations").json()["items"]
            if not calibrations:
                upload(client, calibration_text)
                calibrations = client.get("/api/v1/calibrations").json()["items"]
            return doing(client, engine, {**make_session_body(calibrations[0]["id"]), **names})

    served(lambda client, engine, one: act(client, begun(client, engine, one)[0], "stop"))
    shutil.copy2(settings.database_place, before)
    served(armed_and_stopped)
    assert served(begun)[1].fraction_arming == SIGNED
    shutil.copy2(before, settings.database_place)
    for beside in ("-wal", "-shm"):
        settings.database_place.with_name(f"{settings.database_place.name}{beside}").unlink(missing_ok=True)
    assert served(begun)[1].fraction_arming is None
