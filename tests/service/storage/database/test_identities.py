"""One spelling of a patient, plan and fraction: the first one; spellings of before are named where they are alike."""

import pytest
from hypothesis import given, strategies as st
from sqlalchemy import text

from service.core.identity import identity_key, identity_text, is_of_one_script
from service.storage.database.engine import Database
from service.storage.database.identities import Identity, collisions, keep, stored


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("PL1", "PL1 "),
        ("PL 1", "PL  1"),
        ("PL1", "pl1"),
        ("PL1", "ＰＬ1"),  # noqa: RUF001 - look-alike letters are what is tried
        ("ANN", "АNN"),  # noqa: RUF001
        ("ann", "аnn"),  # noqa: RUF001
        ("Zoë", "Zoe\u0308"),
        ("POM", "ΡΟΜ"),  # noqa: RUF001
        ("STRASSE", "straße"),
    ],
)
def test_what_looks_alike_has_one_key(one, other):
    assert identity_key(one) == identity_key(other)


@pytest.mark.parametrize(("one", "other"), [("P1", "P2"), ("P10", "P1O"), ("Иванов", "Петров"), ("肺", "脳")])
def test_what_differs_has_two(one, other):
    assert identity_key(one) != identity_key(other)


@given(st.text(min_size=1, max_size=20))
def test_the_stored_text_has_the_key_of_what_was_entered_and_is_stored_as_it_is(entered):
    try:
        shown = identity_text(entered)
    except ValueError:
        return
    assert identity_text(shown) == shown
    assert identity_key(shown) == identity_key(entered)


@pytest.mark.parametrize(
    ("name", "is_one"),
    [
        ("Anna Müller", True),
        ("А. Иванов", True),  # noqa: RUF001
        ("аnn", False),  # noqa: RUF001
        ("山田 はなこ", True),
        ("Ann 山田", False),
        ("123", True),
    ],
)
def test_a_person_s_name_is_of_one_script(name, is_one):
    assert is_of_one_script(name) is is_one


@pytest.mark.both_databases
def test_the_first_spelling_is_kept_for_each_patient_by_itself(database):
    database.migrate()
    with database.write() as db:
        assert keep(db, "P1", "Lung ", "FX-1") == Identity("P1", "Lung", "FX-1")
        assert keep(db, "p1 ", "LUNG", "fx-1") == Identity("P1", "Lung", "FX-1")
        assert keep(db, "P2", "LUNG", "fx-1") == Identity("P2", "LUNG", "fx-1")
        assert stored(db, "p2", "lung", "FX-9") == Identity("P2", "LUNG", "FX-9")


ROWS = [("P1", "PL1", "F1"), ("P1", "PL1 ", "F1"), ("p1", "PL1", "F2"), ("P1", "PL1", "F1"), ("P2", "pl1", "F1")]
CALIBRATION = (
    "INSERT INTO calibrations (id, sha256, camera, document, uploaded_by, created_at) "
    "VALUES ('cal', 'c', 'cam', '{}', 'me', '2026-01-01T00:00:00.000000Z')"
)
SESSION = (
    "INSERT INTO sessions (id, status, status_detail, patient_reference, plan_id, fraction_id, operator, source, "
    '"window", calibration_id, is_simulated_beam, created_at) '
    "VALUES (:id, 'ended', '', :one, :two, :three, 'me', '{}', '{}', 'cal', :beam, :at)"
)


@pytest.mark.both_databases
@pytest.mark.slow
def test_the_migration_names_spellings_that_are_alike_and_merges_none(empty_place):
    database = Database(empty_place)
    database.migrate("0001")
    with database.write() as db:
        db.execute(text(CALIBRATION))
        for number, (one, two, three) in enumerate(ROWS):
            at = f"2026-01-01T00:00:0{number}.000000Z"
            db.execute(
                text(SESSION), {"id": f"{number:032d}", "one": one, "two": two, "three": three, "beam": True, "at": at}
            )
    database.migrate()
    with database.connect() as connection:
        found = [tuple(one) for one in collisions(connection)]
    assert found == [("patient", "p1", "P1"), ("plan", "PL1 ", "PL1")]
    with database.write() as db:
        assert keep(db, "p1", "pl1 ", "f1") == Identity("P1", "PL1", "F1")
        kept = db.execute(text("SELECT patient_reference, plan_id FROM sessions ORDER BY id")).all()
    assert [tuple(one) for one in kept] == [(patient, plan) for patient, plan, _ in ROWS]
    database.close()
