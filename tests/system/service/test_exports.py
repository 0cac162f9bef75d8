"""What other systems open of a session that the real service ran: by the API, and by the commands."""

import csv
import io
import shutil

import numpy as np
import pytest
from pydicom import dcmread
from typer.testing import CliRunner

from engine.core.errors import InvalidValueError
from service.cli import app
from service.core.settings.settings import Settings
from service.exchange.dicom import read_waveform
from service.exchange.four_d_ct import breaths_of
from service.web.app import create_app
from tests.support.exchange.orthanc import Orthanc
from tests.support.replay.real_sessions import SOON, DeliberatePerson, Played, Troubles, play
from tests.support.service.accounts import PASSWORD, PeopleClient, QuickHashing
from tests.support.service.api_calls import audit_rows
from tests.support.service.processes import free_port
from tests.support.waiting import eventually

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def played(tmp_path_factory, regular_volunteer) -> Played:
    data_dir = tmp_path_factory.mktemp("exported") / "data"
    return play(
        data_dir, regular_volunteer, seed=12, troubles=Troubles(loss=0.02), window=SOON, person=DeliberatePerson()
    )


@pytest.fixture(scope="module")
def client(played):
    with PeopleClient(create_app(Settings(data_dir=played.data_dir, allowed_hosts=("testserver",)))) as client:
        client.desk.logins._hashing = QuickHashing()
        yield client


@pytest.fixture(scope="module")
def samples(client, played):
    text = client.get(f"/api/v1/sessions/{played.session_id}/samples?format=csv").text
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    return list(csv.DictReader(lines))


def exported(client, played, form):
    answer = client.get(f"/api/v1/sessions/{played.session_id}/{form}")
    assert answer.status_code == 200, answer.text
    assert answer.headers["Content-Type"] == "application/dicom"
    return answer.content


def column(samples, name):
    return np.array([float(row[name]) if row[name] else np.nan for row in samples])


def test_the_waveform_has_every_sample_and_the_gate(client, played, samples):
    raw = exported(client, played, "waveform.dcm")
    found = read_waveform(raw)
    for name in ("thorax", "abdomen"):
        np.testing.assert_allclose(found.motion_mm[name], column(samples, f"{name}_mm"), rtol=0, atol=0.00051)
    at = column(samples, "timestamp_us")
    np.testing.assert_allclose(found.time_s, (at - at[0]) / 1e6, rtol=0, atol=1e-9)
    assert "beam on" in found.annotations
    assert any(text.startswith("hold: ") for text in found.annotations)
    made = dcmread(io.BytesIO(raw))
    session = client.get(f"/api/v1/sessions/{played.session_id}").json()
    assert made.PatientID == session["patient_reference"]
    assert raw == exported(client, played, "waveform.dcm")


def test_the_report_is_the_pdf_of_the_same_study(client, played):
    made = dcmread(io.BytesIO(exported(client, played, "report.dcm")))
    pdf = client.get(f"/api/v1/sessions/{played.session_id}/report.pdf").content
    assert made.EncapsulatedDocument[: made.EncapsulatedDocumentLength] == pdf
    waveform = dcmread(io.BytesIO(exported(client, played, "waveform.dcm")))
    assert made.StudyInstanceUID == waveform.StudyInstanceUID


def test_a_de_identified_waveform_names_nobody_and_the_audit_says_so(client, played):
    raw = exported(client, played, "waveform.dcm?deidentify_as=ANON-7")
    session = client.get(f"/api/v1/sessions/{played.session_id}").json()
    for name in ("patient_reference", "plan_id"):
        assert session[name].encode() not in raw
    assert dcmread(io.BytesIO(raw)).PatientID == "ANON-7"
    rows = [row["detail"]["format"] for row in audit_rows(client, "report.export")]
    assert "dcm, de-identified" in rows


@pytest.mark.parametrize("wrong", ["", "x" * 65])
def test_an_identifier_out_of_its_bounds_is_refused_by_name(client, played, wrong):
    answer = client.get(f"/api/v1/sessions/{played.session_id}/waveform.dcm", params={"deidentify_as": wrong})
    assert answer.status_code == 422
    assert "deidentify_as" in answer.text


def test_the_commands_write_the_same_files(client, played, tmp_path):
    words = ["export", "dicom", played.session_id, "--out", str(tmp_path / "dicom"), "--data", str(played.data_dir)]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    for name in ("waveform.dcm", "report.dcm"):
        assert (tmp_path / "dicom" / name).read_bytes() == exported(client, played, name)
    hidden = CliRunner().invoke(app, [*words[:4], str(tmp_path / "anon"), *words[5:], "--deidentify", "ANON-7"])
    assert hidden.exit_code == 0, hidden.output
    assert [path.name for path in (tmp_path / "anon").iterdir()] == ["waveform.dcm"]


def test_a_session_has_places_for_4_d_ct_from_its_second_breath_on(client, played, samples, tmp_path):
    at, whole = column(samples, "timestamp_us"), column(samples, "whole_mm")
    try:
        breaths_of((at - at[0]) / 1e6, whole)
        expected = 0
    except InvalidValueError:
        expected = 2
    words = ["export", "4dct", played.session_id, "--out", str(tmp_path / "ct"), "--data", str(played.data_dir)]
    done = CliRunner().invoke(app, words)
    assert (done.exit_code, (tmp_path / "ct").exists()) == (expected, expected == 0), done.output


@pytest.mark.parametrize(
    ("words", "field"),
    [
        (["4dct", "nothing", "--signal", "chest"], "signal"),
        (["4dct", "SESSION", "--bins", "1"], "bins"),
        (["4dct", "5e" * 16], "session"),
        (["dicom", "5e" * 16], "session"),
        (["dicom", "SESSION", "--deidentify", "x" * 65], "deidentify"),
    ],
)
def test_what_cannot_be_exported_is_refused_by_name_and_nothing_is_written(played, tmp_path, words, field):
    given = [played.session_id if word == "SESSION" else word for word in words]
    done = CliRunner().invoke(app, ["export", *given, "--out", str(tmp_path / "no"), "--data", str(played.data_dir)])
    assert done.exit_code == 2, done.output
    assert field in done.output
    assert not (tmp_path / "no").exists()


def sent(client, session_id):
    answer = client.get("/api/v1/pacs").json()
    return next((one for one in answer["items"] if one["session_id"] == session_id), None)


def test_without_a_pacs_nothing_is_sent_and_the_refusal_names_the_setting(client, played):
    report = client.get(f"/api/v1/sessions/{played.session_id}/report").json()
    body = {"content_sha256": report["content_sha256"]}
    answer = client.post(f"/api/v1/sessions/{played.session_id}/send", json=body)
    assert (answer.status_code, answer.json()["field"]) == (409, "exchange.pacs")
    assert client.get("/api/v1/pacs").json() == {"is_configured": False, "items": []}
    assert audit_rows(client, "session.send")[-1]["outcome"] == "refused"


def test_a_person_sends_a_session_and_a_restart_in_between_loses_nothing(played, tmp_path):
    data, archive = tmp_path / "data", Orthanc(tmp_path / "orthanc")
    shutil.copytree(played.data_dir, data)
    settings = Settings(data_dir=data, allowed_hosts=("testserver",), pacs=archive.place)
    path = f"/api/v1/sessions/{played.session_id}"
    with PeopleClient(create_app(settings)) as client:
        client.desk.logins._hashing = QuickHashing()
        report = client.get(f"{path}/report").json()
        stale = client.post(f"{path}/send", json={"content_sha256": "0" * 64})
        assert (stale.status_code, stale.json()["field"]) == (409, "content_sha256")
        answer = client.post(f"{path}/send", json={"content_sha256": report["content_sha256"]})
        assert (answer.status_code, answer.json()["state"]) == (200, "waiting")
        eventually(lambda: sent(client, played.session_id)["tries"] == 1)
        assert "does not answer" in sent(client, played.session_id)["trouble"]
    with archive.running(), PeopleClient(create_app(settings)) as client:
        client.desk.logins._hashing = QuickHashing()
        eventually(lambda: sent(client, played.session_id)["state"] == "sent")
        names = {dcmread(io.BytesIO(one)).SOPClassUID.name for one in archive.files()}
        assert len(names) == 2
        rows = audit_rows(client, "session.sent")
        assert [row["outcome"] for row in rows] == ["failed", "done"]
        assert client.get("/api/v1/pacs").json()["is_configured"] is True


def test_where_the_site_says_so_the_last_signature_sends(played, tmp_path):
    data = tmp_path / "data"
    shutil.copytree(played.data_dir, data)
    place = f"ARCHIVE@localhost:{free_port()}"
    settings = Settings(data_dir=data, allowed_hosts=("testserver",), pacs=place, pacs_takes_signed=True)
    path = f"/api/v1/sessions/{played.session_id}"
    with PeopleClient(create_app(settings)) as client:
        client.desk.logins._hashing = QuickHashing()
        report = client.get(f"{path}/report").json()
        body = {"content_sha256": report["content_sha256"], "meaning": "approved", "password": PASSWORD}
        assert sent(client, played.session_id) is None
        for name in ("C. Reviewer", "D. Reviewer")[: report["signatures_needed"]]:
            answer = client.post(f"{path}/signature", json=body | {"operator": name})
            assert answer.status_code == 200, answer.text
        assert sent(client, played.session_id)["state"] == "waiting"
