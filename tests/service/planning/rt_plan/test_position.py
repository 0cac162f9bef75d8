"""The plan's Patient Position: where the head has to be in this room, and which positions are not measured."""

import json
from datetime import UTC, datetime

import pytest

from engine.core.signals import HeadDirection
from service.planning.rt_plan.errors import PlanPositionError
from service.planning.rt_plan.planned_sessions import head_direction, position_notes, position_of
from service.planning.rt_plan.reading import read_plan
from service.storage.database.engine import Database
from service.storage.database.tables import PlanRow
from tests.support.planning.api_calls import kept, prepare, send
from tests.support.planning.dicom_plans import beam, group, motion, photon_plan, setup, written
from tests.support.service.api_calls import audit_rows

TOP, BOTTOM = HeadDirection.TOP, HeadDirection.BOTTOM
NOT_SUPINE = ["HFP", "FFP", "HFDR", "HFDL", "FFDR", "FFDL", "LFS", "RFP", "SITTING", "HFS2"]


def of(*positions: str | None) -> dict:
    """Make a plan's changes: one beam and one setup for each position."""
    numbers = range(1, len(positions) + 1)
    setups = [setup(number, motion()) for number in numbers]
    for one, position in zip(setups, positions, strict=True):
        del one.PatientPosition
        if position is not None:
            one.PatientPosition = position
    return {
        "PatientSetupSequence": setups,
        "BeamSequence": [beam(number, setup_number=number) for number in numbers],
        "FractionGroupSequence": [group(beams=tuple(numbers))],
    }


def position(*positions: str | None) -> str | None:
    plan = read_plan(written(photon_plan(**of(*positions))))
    return position_of(plan.beams, plan.setups)


def test_the_position_is_read_from_the_setups_of_the_beams():
    assert read_plan(written(photon_plan(**of("FFS")))).setups[0].position == "FFS"
    assert (position("HFS"), position("FFS", "FFS"), position(None)) == ("HFS", "FFS", None)


@pytest.mark.parametrize("term", NOT_SUPINE)
def test_only_supine_patients_are_measured(term):
    with pytest.raises(PlanPositionError, match=f"is {term}: must be HFS or FFS: only supine") as refused:
        position(term)
    assert refused.value.field == "(0018,5100) Patient Position"


def test_a_patient_who_would_have_to_be_turned_between_beams_is_refused():
    with pytest.raises(PlanPositionError, match="is FFS, HFS: must be the same for all beams"):
        position("HFS", "FFS")


def test_a_setup_of_a_beam_that_is_not_treated_does_not_count():
    plan = read_plan(written(photon_plan(**of("HFS", "HFP"))))
    beams = [plan.beams[0], plan.beams[1].model_copy(update={"delivery": "SETUP"})]
    assert position_of(beams, plan.setups) == "HFS"


@pytest.mark.parametrize(
    ("requested", "planned", "gantry", "found"),
    [
        *((None, "HFS", TOP, TOP), (None, "FFS", TOP, BOTTOM), (TOP, "HFS", TOP, TOP), (BOTTOM, "HFS", None, BOTTOM)),
        *((BOTTOM, None, TOP, BOTTOM), (None, None, TOP, None), (None, "HFS", None, None)),
    ],
)
def test_the_head_direction_follows_from_plan_and_room(requested, planned, gantry, found):
    assert head_direction(requested, planned, gantry) is found


@pytest.mark.parametrize(("requested", "planned"), [(BOTTOM, "HFS"), (TOP, "FFS")])
def test_a_head_direction_against_the_plan_is_refused(requested, planned):
    with pytest.raises(PlanPositionError, match=f"must be {requested.opposite}: the plan's position is {planned}"):
        head_direction(requested, planned, TOP)


def test_what_could_not_be_compared_is_reported():
    assert position_notes(TOP, "HFS", TOP) == []
    (unset,) = position_notes(TOP, "HFS", None)
    assert "TIDEGATE_GANTRY_SIDE" in unset
    silent, unknown = position_notes(None, None, TOP)
    assert "no Patient Position" in silent
    assert "only the whole region and its volume may gate" in unknown


@pytest.mark.parametrize(("term", "head"), [("HFS", "top"), ("FFS", "bottom")])
def test_a_session_has_the_plan_s_head_direction(client, asked, term, head):
    session = prepare(client, kept(client, **of(term)), asked).json()
    assert (session["head_direction"], session["warnings"]) == (head, [])
    detail = audit_rows(client, "session.create")[-1]["detail"]
    assert (detail["plan_position"], detail["head_direction"]) == (term, head)


def test_a_contradiction_is_refused_and_audited(client, asked):
    answer = prepare(client, kept(client, **of("FFS")), asked | {"head_direction": "top"})
    problem = answer.json()
    assert (answer.status_code, problem["code"], problem["field"]) == (409, "plan_position", "head_direction")
    assert "FFS" in problem["detail"]
    row = audit_rows(client, "session.create")[-1]
    assert (row["outcome"], row["detail"]["code"]) == ("refused", "plan_position")


def test_a_prone_patient_is_refused(client, asked):
    answer = prepare(client, kept(client, **of("HFP")), asked)
    assert (answer.status_code, answer.json()["code"]) == (409, "plan_position")


@pytest.mark.both_databases
def test_a_plan_that_was_stored_before_positions_were_read_is_not_contradicted_by_its_own_file(client, settings):
    plan = read_plan(written(photon_plan()))
    document = plan.model_dump(mode="json")
    for one in document["setups"]:
        assert one.pop("position") == "HFS"
    columns = plan.model_dump(include={"sop_instance_uid", "kind", "label", "patient_reference", "gating"})
    database = Database(settings.database_place)
    with database.write() as db:
        row = PlanRow(
            id="0" * 32, sha256="1" * 64, document=json.dumps(document), imported_by="A. Physicist", **columns
        )
        row.created_at = datetime.now(UTC)
        db.add(row)
    database.close()
    again = send(client, written(photon_plan()))
    assert (again.status_code, again.json()["id"]) == (200, "0" * 32)
    assert [one["position"] for one in again.json()["setups"]] == [None]
    other = send(client, written(photon_plan(PlanIntent="PALLIATIVE")))
    assert other.json()["code"] == "plan_conflict"
    assert "setups" not in other.json()["detail"]


def test_a_changed_position_contradicts_the_stored_plan(client, plan):
    changed = send(client, written(photon_plan(PatientSetupSequence=of("HFP")["PatientSetupSequence"])))
    assert (changed.status_code, changed.json()["code"]) == (409, "plan_conflict")
    assert "setups" in changed.json()["detail"]
