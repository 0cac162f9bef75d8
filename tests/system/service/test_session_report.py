"""The report of a session that the real service ran: every number again from its exported samples alone."""

import html
import io
import math
import re
import shutil
import sqlite3
import tempfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path

import numpy as np
import pyarrow.ipc
import pyarrow.parquet
import pytest
from typer.testing import CliRunner

from service.cli import app
from service.core.schemas.windows import Window
from service.core.settings.settings import Settings
from service.sessions.report.window_words import window_text
from service.storage.audit import Event
from service.storage.audit.log import AuditLog
from service.storage.database.engine import Database
from service.web.app import create_app
from tests.support.replay.real_sessions import SOON, DeliberatePerson, Played, Troubles, play
from tests.support.service.accounts import PASSWORD, PeopleClient, QuickHashing
from tests.support.service.api_calls import audit_rows

pytestmark = pytest.mark.long

MINUS = "\N{MINUS SIGN}"


@pytest.fixture(scope="module")
def played(tmp_path_factory, regular_volunteer) -> Played:
    data_dir = tmp_path_factory.mktemp("reported") / "data"
    return play(
        data_dir, regular_volunteer, seed=11, troubles=Troubles(loss=0.02), window=SOON, person=DeliberatePerson()
    )


@pytest.fixture(scope="module")
def client(played):
    settings = Settings(data_dir=played.data_dir, allowed_hosts=("testserver",))
    with PeopleClient(create_app(settings)) as client:
        client.desk.logins._hashing = QuickHashing()
        yield client


def export(client, played, form):
    answer = client.get(f"/api/v1/sessions/{played.session_id}/{form}")
    assert answer.status_code == 200, answer.text
    return answer


@pytest.fixture(scope="module")
def samples(client, played):
    body = export(client, played, "samples?format=arrow").content
    return pyarrow.ipc.open_stream(io.BytesIO(body)).read_all().to_pylist()


@pytest.fixture(scope="module")
def stated(client, played) -> dict[str, list[list[str]]]:
    """Each table of the page by its title, as texts."""
    page = export(client, played, "report.html").text
    found = {}
    for title, table in re.findall(r"<h2>(.*?)</h2><table>(.*?)</table>", page, re.DOTALL):
        rows = re.findall(r"<tr>(.*?)</tr>", table, re.DOTALL)
        found[html.unescape(title)] = [
            [html.unescape(cell) for cell in re.findall(r"<t[dh]>(.*?)</t[dh]>", row, re.DOTALL)] for row in rows
        ]
    return found


def seconds_of(samples):
    times = [row["decided_ns"] for row in samples]
    return [min(max(later - now, 0), 10**9) / 1e9 for now, later in zip(times, [*times[1:], times[-1]], strict=True)]


def middle(values, unit):
    """Median and the range of the middle 90 %, linear between values; a dash without any."""
    ordered = sorted(values)
    if not ordered:
        return "\N{EN DASH}"

    def at(share):
        place = share * (len(ordered) - 1)
        low = int(place)
        return ordered[low] + (place - low) * (ordered[min(low + 1, len(ordered) - 1)] - ordered[low])

    return f"{at(0.5):.2f} ({at(0.05):.2f} to {at(0.95):.2f}) {unit}"


def test_beam_pulses_and_duty_are_those_of_the_samples(samples, stated):
    steps = seconds_of(samples)
    on = [step for row, step in zip(samples, steps, strict=True) if row["gate"] == "beam_on"]
    armed = [step for row, step in zip(samples, steps, strict=True) if row["gate"] != "disarmed"]
    runs = groupby(zip(samples, steps, strict=True), key=lambda one: one[0]["gate"] == "beam_on")
    pulses = [sum(step for _, step in run) for is_on, run in runs if is_on]
    assert len(pulses) > 2
    assert dict(stated["Beam"]) == {
        "beam on": f"{sum(on):.2f} s",
        "armed": f"{sum(armed):.2f} s",
        "duty cycle while armed": f"{100.0 * sum(on) / sum(armed):.1f} %",
        "pulses": str(len(pulses)),
        "length of a pulse, median (5 to 95 %)": middle(pulses, "s"),
    }


def test_the_motion_while_the_beam_was_on_is_that_of_the_samples(samples, stated):
    rows = stated["Motion while the beam was on [mm]"][1:]
    assert [row[0] for row in rows] == ["whole", "thorax", "abdomen"]
    for name, *figures in rows:
        values = np.array([row[f"{name}_mm"] for row in samples if row["gate"] == "beam_on"], dtype=float)
        values = values[np.isfinite(values)]
        away = sorted(abs(values - values.mean()))
        place = 0.95 * (len(away) - 1)
        within = away[int(place)] + (place % 1.0) * (away[min(int(place) + 1, len(away) - 1)] - away[int(place)])
        signed = "0.00" if abs(values.mean()) < 0.005 else f"{values.mean():+.2f}".replace("-", MINUS)
        assert figures == [signed, f"{values.std():.2f}", f"±{within:.2f}", str(len(values))]


def test_holds_breathing_and_frames_are_those_of_the_samples(client, samples, stated):
    steps, before, counts, times = seconds_of(samples), "", {}, {}
    texts = {one["code"]: one["text"] for one in client.get("/api/v1/interlocks").json()["items"]}
    for row, step in zip(samples, steps, strict=True):
        reason = (row["hold_reason"] or "") if row["gate"] in {"hold", "fault"} else ""
        if reason:
            counts[reason] = counts.get(reason, 0) + (reason != before)
            times[reason] = times.get(reason, 0.0) + step
        before = reason
    assert counts
    ordered = sorted(counts, key=lambda reason: (-counts[reason], reason))
    wanted = [[texts.get(one, one), str(counts[one]), f"{times[one]:.2f} s"] for one in ordered]
    assert stated["Holds while armed"][1:] == wanted
    periods = [60.0 / row["rate_per_min"] for row in samples if row["rate_per_min"]]
    amplitudes = [row["breath_amplitude"] for row in samples if row["breath_amplitude"] is not None]
    breathing = dict(stated["Breathing"])
    assert breathing["period, median (5 to 95 %)"] == middle(periods, "s")
    assert breathing["amplitude, median (5 to 95 %)"] == middle(amplitudes, "mm")
    lost = sum(row["state"] == "lost" for row in samples)
    missed = sum(row["missed_frames"] for row in samples)
    measured = dict(stated["Measurement"])
    assert measured["recorded"] == f"{sum(steps):.2f} s, {len(samples)} frames"
    assert measured["not measured; never received"] == f"{lost}; {missed}"


def test_it_says_who_did_what_and_what_is_to_be_looked_at(stated):
    acts = [row[2] for row in stated["Who did what"][1:]]
    assert acts[0] == "created"
    assert {"started", "reference set", "armed"} <= {one.partition(" (")[0] for one in acts}
    assert ["the beam line was simulated"] in stated["To be looked at"]
    versions = dict(stated["Versions and hashes"])
    assert all(len(versions[f"{name}, SHA-256"]) == 64 for name in ("samples", "calibration"))


def test_the_pdf_is_the_same_each_time_and_has_two_pages_at_most(client, played):
    first, second = (export(client, played, "report.pdf") for _ in range(2))
    assert first.headers["content-type"] == "application/pdf"
    assert first.content == second.content
    assert first.content.startswith(b"%PDF-")
    assert 1 <= len(re.findall(rb"/Type\s*/Page\b", first.content)) <= 2
    assert [row["detail"] for row in audit_rows(client, "report.export")][-1] == {"format": "pdf"}


def test_the_command_writes_what_the_service_answers(client, played, tmp_path, monkeypatch):
    monkeypatch.setenv("TIDEGATE_DATA_DIR", str(played.data_dir))
    out = tmp_path / "report.pdf"
    answer = CliRunner().invoke(app, ["report", played.session_id, "--out", str(out)])
    assert answer.exit_code == 0, answer.output
    assert out.read_bytes() == export(client, played, "report.pdf").content
    refused = CliRunner().invoke(app, ["report", played.session_id, "--out", str(tmp_path / "report.doc")])
    assert refused.exit_code == 2
    assert "out must end in .pdf or .html" in refused.output
    missing = CliRunner().invoke(app, ["report", "0" * 32, "--out", str(out)])
    assert (missing.exit_code, list(tmp_path.iterdir())) == (2, [out])


def test_latencies_are_counted_in_steps_of_5_ms(client, played, samples):
    counted = [0] * 41
    for row in samples:
        ns = row["asserted_ns"] - (row["captured_ns"] or row["received_ns"])
        counted[min(max(ns, 0) // 5_000_000, 40)] += 1
    assert export(client, played, "report").json()["figures"]["latency_bins"] == counted


def sign(client, played, name, **changes):
    shown = export(client, played, "report").json()
    body = {"operator": name, "content_sha256": shown["content_sha256"]} | changes
    if "note" in body:
        return client.post(f"/api/v1/sessions/{played.session_id}/note", json=body)
    body = {"meaning": "checked", "password": PASSWORD} | body
    return client.post(f"/api/v1/sessions/{played.session_id}/signature", json=body)


def test_a_report_is_signed_once_by_each_person_as_it_was_looked_at(client, played):
    refused = sign(client, played, "A. Physicist", content_sha256="00" * 32)
    assert (refused.status_code, refused.json()["field"]) == (409, "content_sha256")
    assert sign(client, played, "A. Physicist", note="").status_code == 422, "a note has a text"
    noted = sign(client, played, "A. Physicist", note="two coughs")
    assert [(one["is_signed"], one["note"]) for one in noted.json()["signatures"]] == [(False, "two coughs")]
    before = export(client, played, "report.pdf").content
    signed = sign(client, played, "A. Physicist").json()
    assert [one["name"] for one in signed["signatures"] if one["is_signed"]] == ["A. Physicist"]
    again = sign(client, played, "A. Physicist")
    assert (again.status_code, again.json()["field"]) == (409, "operator")
    assert sign(client, played, "B. Physicist").status_code == 200
    assert export(client, played, "report.pdf").content != before
    page = export(client, played, "report.html").text
    assert "two coughs" in page
    assert page.count("signed as checked 20") == 2
    events = export(client, played, "report").json()["events"]
    texts = [one["text"] for one in events if one["action"] in {"session.note", "session.signature"}]
    done = ["note added to the report", "report signed (checked)", "report signed (checked)"]
    assert [text for text in texts if "refused" not in text] == done
    outcomes = [(row["action"], row["outcome"]) for row in audit_rows(client)]
    assert [outcomes.count((action, "done")) for action in ("session.note", "session.signature")] == [1, 2]
    assert outcomes.count(("session.signature", "refused")) == 2


def test_a_signature_needs_the_persons_own_password_and_a_meaning(client, played):
    assert sign(client, played, "G. Physicist", meaning="seen").status_code == 422
    for wrong in ({"password": "another one"}, {"password": None}):
        refused = sign(client, played, "G. Physicist", **wrong)
        assert (refused.status_code, refused.json()["code"]) == (422, "signer_unconfirmed")
        assert "another one" not in refused.text
    assert not any(one["name"] == "G. Physicist" for one in export(client, played, "report").json()["signatures"])
    signed = sign(client, played, "G. Physicist", meaning="approved").json()["signatures"][-1]
    assert (signed["name"], signed["is_signed"], signed["meaning"]) == ("G. Physicist", True, "approved")
    row = audit_rows(client, "session.signature")[-1]
    assert (row["detail"]["meaning"], row["detail"]["confirmed_by"]) == ("approved", "password")
    assert "password" not in row["detail"]
    assert 429 in [sign(client, played, "H. Physicist", password="guessed").status_code for _ in range(8)]


def test_of_two_signatures_of_one_person_at_once_one_is_refused(client, played):
    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(lambda _: sign(client, played, "A. Therapist").status_code, range(4)))
    assert sorted(answers) == [200, 409, 409, 409]


def test_two_persons_sign_where_one_went_beyond_a_limit_with_a_reason(client, played):
    reasoned = [
        row
        for name in ("arm", "reference", "window", "baseline_correction", "position_check")
        for row in audit_rows(client, f"session.{name}")
        if row["outcome"] == "done" and row["detail"].get("reason")
    ]
    assert export(client, played, "report").json()["signatures_needed"] == (2 if reasoned else 1)


def test_cells_are_those_of_the_samples_with_the_beam_on(client, played, samples):
    shown = export(client, played, "report").json()["figures"]["cells"]
    on = [row for row in samples if row["gate"] == "beam_on" and row["region_rows"] is not None]
    rows = on[0]["region_rows"]
    columns = len(on[0]["regions_mm"]) // rows
    assert (len(shown), {len(row) for row in shown}) == (rows, {columns})
    for place in range(rows * columns):
        values = [row["regions_mm"][place] for row in on]
        known = [value for value in values if not math.isnan(value)]
        found = shown[place // columns][place % columns]
        if len(known) < 30:
            assert found is None
            continue
        mean = math.fsum(known) / len(known)
        away = sorted(abs(value - mean) for value in known)
        at = 0.95 * (len(away) - 1)
        wanted = away[int(at)] + (at - int(at)) * (away[min(int(at) + 1, len(away) - 1)] - away[int(at)])
        assert found == pytest.approx(wanted, abs=0.0051)


def test_a_part_of_the_trace_and_a_moment_are_those_of_the_samples(client, played, samples):
    times = [(row["decided_ns"] - samples[0]["decided_ns"]) / 1e9 for row in samples]
    found = client.get(f"/api/v1/sessions/{played.session_id}/trace", params={"points": 50}).json()
    assert found["end_s"] == pytest.approx(times[-1], abs=1e-3)
    edges = [*found["times_s"], float("inf")]
    for one in found["signals"]:
        for i, (low, high) in enumerate(zip(one["low_mm"], one["high_mm"], strict=True)):
            inside = [row for t, row in zip(times, samples, strict=True) if edges[i] - 5e-4 <= t < edges[i + 1] - 5e-4]
            known = [row[f"{one['signal']}_mm"] for row in inside if row[f"{one['signal']}_mm"] is not None]
            assert (low, high) == ((round(min(known), 3), round(max(known), 3)) if known else (None, None))
    on_s = sum(to - begin for begin, to in found["beams_s"])
    steps = seconds_of(samples)
    assert on_s == pytest.approx(
        sum(step for row, step in zip(samples, steps, strict=True) if row["gate"] == "beam_on"), abs=0.01 * len(steps)
    )
    measured = [i for i, row in enumerate(samples) if row["whole_mm"] is not None]
    index = min(measured, key=lambda i: samples[i]["whole_mm"])
    moment = client.get(f"/api/v1/sessions/{played.session_id}/moment", params={"at_s": times[index]}).json()
    assert moment["frame_index"] == samples[index]["frame_index"]
    cells = [one for line in moment["cells_mm"] for one in line]
    wanted = [None if math.isnan(one) else round(one, 3) for one in samples[index]["regions_mm"]]
    assert cells == pytest.approx(wanted, abs=1e-3, nan_ok=True)
    # The surface lies at the camera's distance, and a deeper breath is nearer to the camera.
    deepest = max(measured, key=lambda i: samples[i]["whole_mm"])
    inhaled = client.get(f"/api/v1/sessions/{played.session_id}/moment", params={"at_s": times[deepest]}).json()

    def depth_mm(one):
        return np.mean([node[2] for line in one["surface_mm"] for node in line if node is not None])

    shift = samples[deepest]["whole_mm"] - samples[index]["whole_mm"]
    assert shift > 2.0
    assert depth_mm(moment) - depth_mm(inhaled) == pytest.approx(shift, abs=0.6)
    assert 600.0 < depth_mm(moment) < 1200.0


@contextmanager
def changed_row(played, statement, back):
    """Change the database beside the service, as somebody with its file can, and change it back."""
    place = Settings(data_dir=played.data_dir).database_place
    for one in (statement, back):
        with sqlite3.connect(place) as file:
            file.execute(*one)
        file.close()
        if one is statement:
            yield


def test_the_windows_are_the_prescribed_one_and_each_later_one_with_who_and_when(client, played, stated):
    report = export(client, played, "report").json()
    created = audit_rows(client, "session.create")[0]
    first, *later = report["windows"]
    assert (first["actor"], first["text"][:15]) == (created["actor"], "as prescribed: ")
    assert first["text"] == f"as prescribed: {window_text(Window.model_validate(created['detail']['window']))}"
    acts = [row for name in ("window", "baseline_correction") for row in audit_rows(client, f"session.{name}")]
    assert len(later) == len([row for row in acts if row["outcome"] == "done"])
    session = next(rows for title, rows in stated.items() if title.startswith("Session ("))
    rows = [row for row in session if row[0].startswith("window, ")]
    assert [row[1].split(" (")[0] for row in rows] == [one["text"] for one in report["windows"]]


def test_a_reference_is_stated_with_its_moment_and_where_it_lies(client, played):
    texts = [one["text"] for one in export(client, played, "report").json()["events"]]
    asked = next(one for one in texts if one.startswith("reference set"))
    assert re.search(r"\((end of exhale|end of inhale|the present level)", asked), asked
    taken = next(one for one in texts if one.startswith("reference taken up"))
    assert re.search(r"first reference of this fraction|mm from the fraction's first", taken), taken


def test_a_report_whose_content_is_not_what_was_signed_says_so_first_and_takes_its_head_from_the_audit(client, played):
    sign(client, played, "C. Physicist")
    signed = export(client, played, "report").json()
    assert signed["differs"] == []
    patient, row_id = signed["session"]["patient_reference"], played.session_id
    update = "UPDATE sessions SET patient_reference = ? WHERE id = ?"
    with changed_row(played, (update, ("P-OTHER", row_id)), (update, (patient, row_id))):
        changed = export(client, played, "report").json()
        page = export(client, played, "report.html").text
        pdf = export(client, played, "report.pdf").content
    assert changed["session"]["patient_reference"] == patient
    assert f"the database states patient_reference 'P-OTHER', and the audit '{patient}'" in changed["differs"]
    assert any("the content differs from what C. Physicist signed" in one for one in changed["differs"])
    assert not any(one["is_of_this"] for one in changed["signatures"] if one["is_signed"])
    assert page.index("content differs from what") < page.index("<h1>")
    assert len(pdf) > 1_000
    assert export(client, played, "report").json() == signed


def test_samples_that_were_cut_are_another_content(client, played):
    sign(client, played, "D. Physicist")
    place = played.data_dir / "samples" / f"{played.session_id}.parquet"
    whole = place.read_bytes()
    table = pyarrow.parquet.read_table(place)
    try:
        pyarrow.parquet.write_table(table.slice(0, table.num_rows // 2), place)
        answer = client.get(f"/api/v1/sessions/{played.session_id}/report")
    finally:
        place.write_bytes(whole)
    if answer.status_code == 200:  # or it is refused as damaged
        assert any("D. Physicist signed" in one for one in answer.json()["differs"])
    else:
        assert answer.json()["code"] in {"samples_damaged", "samples_missing"}
    assert export(client, played, "report").json()["differs"] == []


def test_where_the_site_asks_for_two_one_of_them_has_not_armed(played):
    """Signed anew in a copy: who armed, and a second person who armed, are not two independent ones."""
    with tempfile.TemporaryDirectory() as folder:
        data_dir = shutil.copytree(played.data_dir, f"{folder}/data")
        place = Settings(data_dir=Path(data_dir)).database_place
        settings = Settings(data_dir=Path(data_dir), allowed_hosts=("testserver",), countersignature=True, room="Later")
        with PeopleClient(create_app(settings)) as client:
            client.desk.logins._hashing = QuickHashing()
            report = export(client, played, "report").json()
            assert report["signatures_needed"] == 2
            assert report["head"]["room"] == "", "as it was when the session was created"
            armed = {one["actor"] for one in report["events"] if one["action"] == "session.arm"}
            (armer,) = armed
            AuditLog(Database(place)).write(
                Event(actor="E. Therapist", action="session.arm", session_id=played.session_id)
            )
            assert [sign(client, played, name).status_code for name in (armer, "E. Therapist")] == [200, 409]
            assert sign(client, played, "F. Physicist").status_code == 200
            assert client.get("/api/v1/sessions").json()["items"][0]["signed_by"][-1] == "F. Physicist"
