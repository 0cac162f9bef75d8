"""Plans over HTTP: kept once and as they were read, the same for the same; a refused one leaves nothing behind."""

import hashlib
import hmac
import json
import logging
import threading

import pytest

from service.core.settings.settings import Settings
from service.web.app import create_app
from service.web.middleware.requests import MAX_BODY_BYTES, MAX_PLAN_BYTES
from tests.support.planning.api_calls import DICOM, URL, kept, send
from tests.support.planning.dicom_plans import PATIENT_NAME, SYNTAXES, UID, group, ion_plan, photon_plan, written
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import audit_rows

pytestmark = pytest.mark.slow


def listed(client):
    return client.get(URL).json()["items"]


@pytest.mark.both_databases
def test_an_imported_plan_can_be_read_back(client):
    content = written(photon_plan())
    answer = send(client, content)
    assert answer.status_code == 201
    plan = answer.json()
    assert (plan["label"], plan["patient_reference"], plan["sop_instance_uid"]) == ("LUNG_DIBH", "P-0001", UID)
    assert (plan["gating"], plan["kind"], plan["imported_by"]) == ("breath_hold", "RT Plan", "A. Therapist")
    assert plan["sha256"] == hashlib.sha256(content).hexdigest()
    assert client.get(f"{URL}/{plan['id']}").json() == plan
    assert [one["id"] for one in listed(client)] == [plan["id"]]


def test_an_ion_plan_is_kept_as_one(client):
    assert send(client, written(ion_plan())).json()["kind"] == "RT Ion Plan"


@pytest.mark.both_databases
def test_the_same_plan_again_is_the_plan_that_is_there_however_it_is_written(client, plan):
    for syntax in SYNTAXES:
        again = send(client, written(photon_plan(), syntax))
        assert (again.status_code, again.json()) == (200, plan)
    assert len(listed(client)) == 1


@pytest.mark.both_databases
def test_another_plan_of_the_same_uid_is_refused_and_nothing_changes(client, plan):
    answer = send(client, written(photon_plan(FractionGroupSequence=[group(fractions=29)])))
    problem = answer.json()
    assert (answer.status_code, problem["code"], problem["value"]) == (409, "plan_conflict", UID)
    assert "fraction_groups" in problem["detail"]
    there = client.get(f"{URL}/{plan['id']}").json()
    assert there["contradicted"]["differing"] == ["fraction_groups"]
    assert there | {"contradicted": None} == plan


@pytest.mark.both_databases
def test_a_key_gives_the_same_answer_and_refuses_another_file(client):
    headers = {"Idempotency-Key": "k1"}
    first = send(client, written(photon_plan()), **headers)
    assert send(client, written(photon_plan()), **headers).json() == first.json()
    other = send(client, written(photon_plan(SOPInstanceUID="1.2.3")), **headers)
    assert (other.status_code, other.json()["code"]) == (409, "idempotency_key_reused")


@pytest.mark.both_databases
def test_plans_are_listed_newest_first_page_by_page_and_by_patient_and_label(client):
    made = [
        kept(client, SOPInstanceUID=f"1.2.{number}", PatientID=f"P-{number % 2}", RTPlanLabel=f"L{number}")["id"]
        for number in range(4)
    ]
    first = client.get(URL, params={"limit": 3}).json()
    rest = client.get(URL, params={"limit": 3, "cursor": first["next_cursor"]}).json()
    assert [one["id"] for one in first["items"] + rest["items"]] == made[::-1]
    assert rest["next_cursor"] is None
    of_patient = client.get(URL, params={"patient_reference": "P-1"}).json()["items"]
    assert [one["id"] for one in of_patient] == [made[3], made[1]]
    assert [one["id"] for one in client.get(URL, params={"label": "L2"}).json()["items"]] == [made[2]]
    both = {"patient_reference": "P-1", "label": "L2"}
    assert client.get(URL, params=both).json()["items"] == []


def test_a_plan_never_changes_and_its_etag_states_it(client, plan):
    answer = client.get(f"{URL}/{plan['id']}")
    again = client.get(f"{URL}/{plan['id']}", headers={"If-None-Match": answer.headers["ETag"]})
    assert again.status_code == 304


def test_a_plan_that_is_not_there_is_not_found(client):
    for plan_id in ("0" * 32, "x", "..%2f.."):
        assert client.get(f"{URL}/{plan_id}").status_code in {404, 422}


BAD = [
    (b"", "plan_not_dicom"),
    (b'{"label": "x"}', "plan_not_dicom"),
    (b"\xff\xd8\xff\xe0", "plan_not_dicom"),
    (written(photon_plan())[:400], "plan_truncated"),
    (written(photon_plan(SOPClassUID="1.2.840.10008.5.1.4.1.1.2")), "plan_wrong_kind"),
    (written(photon_plan(PatientID=None)), "plan_invalid"),
]


def test_what_is_refused_is_audited_and_leaves_nothing(client, settings):
    before = {path for path in settings.data_dir.rglob("*") if path.is_file()}
    for content, code in BAD:
        answer = send(client, content)
        problem = answer.json()
        assert (answer.status_code, problem["code"]) == (422, code)
        assert problem["field"]
        assert problem["bound"]
        row = audit_rows(client, "plan.import")[-1]
        assert (row["outcome"], row["detail"]["code"], row["detail"]["bytes"]) == ("refused", code, len(content))
    assert listed(client) == []
    assert {path for path in settings.data_dir.rglob("*") if path.is_file()} == before


def test_a_file_larger_than_the_bound_is_refused_by_its_length_alone(client):
    answer = send(client, b"x", **{"Content-Length": str(MAX_PLAN_BYTES + 1)})
    assert (answer.status_code, answer.json()["code"]) == (413, "body_too_large")
    assert str(MAX_PLAN_BYTES) in answer.json()["bound"]


def test_a_stream_of_unknown_length_is_cut_off_at_the_bound(client):
    def endless():
        for _ in range(MAX_PLAN_BYTES // 65_536 + 2):
            yield b" " * 65_536

    answer = send(client, endless())
    assert (answer.status_code, answer.json()["code"]) == (413, "body_too_large")


def test_only_plans_may_be_as_large_as_plans(client):
    body = b" " * (MAX_BODY_BYTES + 1)
    assert send(client, body).status_code == 422
    for path in ("/api/v1/calibrations", f"{URL}/{'0' * 32}/sessions", f"{URL}/"):
        answer = client.post(path, content=body, headers={"Content-Type": "application/json"})
        assert answer.status_code in {404, 413}


def test_only_dicom_is_taken(client):
    for media_type in ("application/json", "multipart/form-data", ""):
        answer = client.post(URL, content=written(photon_plan()), headers={"Content-Type": media_type})
        bound = "application/dicom or application/octet-stream"
        assert (answer.status_code, answer.json()["bound"]) == (415, bound)
    plain = client.post(URL, content=written(photon_plan()), headers={"Content-Type": "application/octet-stream"})
    assert plain.status_code == 201


def test_a_plan_is_imported_only_with_the_permission(client):
    client.headers_as("V. Iewer", ["viewer"])
    client.headers_as("T. Herapist", ["therapist"])
    for name in ("V. Iewer", "T. Herapist"):
        client.speaks_as = name
        answer = send(client, written(photon_plan()))
        assert (answer.status_code, answer.json()["bound"]) == (403, "plans.write")
        assert client.get(URL).status_code == 200
    client.speaks_as = None
    assert client.post(URL, content=b"", headers=DICOM).status_code == 401


def test_the_patients_name_is_in_no_answer_row_log_or_file(client, settings, caplog):
    with caplog.at_level(logging.DEBUG):
        plan = kept(client)
        send(client, written(photon_plan())[:500])
        send(client, written(photon_plan(FractionGroupSequence=[group(fractions=1)])))
    reported = json.dumps([plan, audit_rows(client), listed(client)]) + caplog.text
    names = [word.encode() for word in PATIENT_NAME.split("^")]
    files = b"".join(path.read_bytes() for path in settings.data_dir.rglob("*") if path.is_file())
    assert not any(name in reported.encode() or name in files for name in [*names, b"19500101"])


def test_the_audit_states_what_came_and_who_sent_it(client, plan):
    send(client, written(photon_plan()))
    first, again = audit_rows(client, "plan.import")
    assert (first["actor"], first["outcome"]) == ("A. Therapist", "done")
    assert (first["detail"]["rt_plan_id"], first["detail"]["is_new"], again["detail"]["is_new"]) == (
        plan["id"],
        True,
        False,
    )
    assert first["detail"]["sha256"] == plan["sha256"]


def test_an_export_without_patients_states_nothing_of_whose_plan_came(client, plan):
    send(client, written(photon_plan(FractionGroupSequence=[group(fractions=1)])))  # refused: a row of its own
    without = client.get("/api/v1/audit/export", params={"with_patients": False}).text
    assert without.count("plan.import") >= 2
    assert not any(word in without for word in ("P-0001", "LUNG_DIBH", UID))


def test_no_more_files_are_in_memory_than_there_are_places(client):
    """One of two is held in the middle of its body, both places are taken, and a third is asked to come again."""
    repository = client.app.state.services.plans
    entered, leave = threading.Barrier(3), threading.Event()

    def hold():
        with repository.upload_slot():
            entered.wait(5)
            leave.wait(5)

    holders = [threading.Thread(target=hold) for _ in range(2)]
    for holder in holders:
        holder.start()
    entered.wait(5)
    try:
        answer = send(client, written(photon_plan()))
    finally:
        leave.set()
        for holder in holders:
            holder.join(5)
    assert (answer.status_code, answer.json()["code"], answer.headers["Retry-After"]) == (503, "plan_busy", "1")
    assert send(client, written(photon_plan())).status_code == 201
    for _ in range(5):  # a refusal gives its place back, too
        assert send(client, b"x").status_code == 422


def test_a_site_may_keep_a_keyed_hash_in_the_place_of_the_patient_id(settings, engine, tmp_path):
    secret = b"s" * 40
    key_file = tmp_path / "plan-patients.key"
    key_file.write_bytes(secret + b"\n")
    hashing = settings.model_copy(update={"plan_patient": "hash", "plan_patient_key": key_file})
    with PeopleClient(create_app(hashing, lambda _settings: engine)) as client:
        plan = kept(client)
        reported = json.dumps([plan, audit_rows(client), listed(client)])
    hashed = hmac.new(secret, b"P-0001", hashlib.sha256).hexdigest()
    assert plan["patient_reference"] == f"h-{hashed[:32]}"
    assert "P-0001" not in reported
    files = b"".join(path.read_bytes() for path in settings.data_dir.rglob("*") if path.is_file())
    assert b"P-0001" not in files
    assert secret.decode() not in repr(hashing)


@pytest.mark.parametrize(
    "changes",
    [
        {"plan_patient": "hash"},
        {"plan_patient": "id", "plan_patient_key": "KEY"},
        {"plan_patient": "hash", "key": b"x"},
    ],
)
def test_a_hash_without_a_key_worth_the_name_is_refused_at_the_start(tmp_path, changes):
    file = tmp_path / "key"
    file.write_bytes(changes.pop("key", b"k" * 32))
    if changes.get("plan_patient_key") or file.read_bytes() == b"x":
        changes["plan_patient_key"] = file
    with pytest.raises(ValueError, match="TIDEGATE_PLAN_PATIENT_KEY"):
        Settings(data_dir=tmp_path, **changes)
