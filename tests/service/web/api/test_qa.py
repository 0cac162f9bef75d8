"""QA runs over HTTP: begun once, one at a time, never beside a session, cancelled line first, kept for good."""

import hashlib
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import timedelta
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError

from engine.core.errors import BeamLineError, InvalidValueError
from engine.qa.bounds import BASELINE_BOUNDS
from engine.qa.checks import CHECKS, checks_of
from engine.qa.results import QaKind
from service.core.permissions import KEY_PERMISSIONS, Permission, Role
from service.engine_host.equipment import EquipmentSlot
from service.qa import queries as records
from service.qa.one_time_code import OneTimeCodes
from service.qa.schemas import QaExpected
from service.storage.database import queries
from service.web.app import create_app
from tests.support.database.migrated import with_tables
from tests.support.qa.fake_rig import FakeRig, qa_files
from tests.support.qa.sample_runs import report, sample_series
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import OPERATOR, act, audit_rows, make_session_body, upload
from tests.support.service.busy_threads import (
    CONNECTIONS,
    LONGEST_S,
    THREADS,
    ask_for_lists,
    reads,
    waiting_for_a_thread,
)
from tests.support.waiting import eventually

pytestmark = [pytest.mark.both_databases, pytest.mark.long, pytest.mark.slow, pytest.mark.verification]

URL = "/api/v1/qa"
ME = {"operator": "A. Physicist"}


@pytest.fixture
def rig() -> Iterator[FakeRig]:
    rig = FakeRig()
    yield rig
    rig.go_on.set()


@pytest.fixture
def client(settings, engine, rig: FakeRig, migrated_file) -> Iterator[PeopleClient]:
    qa_files(settings.recordings_dirs[0])
    with_tables(settings, migrated_file)
    with PeopleClient(create_app(settings, lambda _settings: engine, lambda _settings: rig)) as client:
        yield client


@pytest.fixture
def body(calibration_id) -> dict[str, Any]:
    return {
        "kind": "daily",
        **ME,
        "calibration_id": calibration_id,
        "plate": {"source": {"kind": "recording", "path": "plate.oni"}},
    }


@pytest.fixture
def monthly(body) -> dict[str, Any]:
    phantom = {"source": {"kind": "recording", "path": "phantom.oni"}, "trace": "sine.csv"}
    return body | {"kind": "monthly", "phantom": phantom | {"window_lower_mm": -60.0, "window_upper_mm": 5.0}}


def begin(client, body, **headers) -> str:
    answer = client.post(f"{URL}/runs", json=body, headers=headers)
    assert answer.status_code == 202, answer.text
    return answer.json()["id"]


def read(client, run_id) -> dict[str, Any]:
    return client.get(f"{URL}/runs/{run_id}").json()


def finish(client, rig, run_id) -> dict[str, Any]:
    rig.go_on.set()
    eventually(lambda: read(client, run_id)["status"] != "running")
    rig.go_on.clear()
    return read(client, run_id)


def done(client, rig, body) -> dict[str, Any]:
    return finish(client, rig, begin(client, body))


def test_a_run_begins_goes_on_and_is_kept_with_every_check(client, rig, body):
    rig.report = report(QaKind.DAILY, series=sample_series(), plate_noise_mm=2.5)
    run_id = begin(client, body)
    eventually(rig.job_now.is_on.is_set)
    under_way = read(client, run_id)
    assert (under_way["status"], under_way["verdict"], under_way["results"]) == ("running", None, [])
    assert under_way["progress"]["stage"] == "beam"
    ended = finish(client, rig, run_id)
    assert (ended["status"], ended["verdict"], ended["progress"]) == ("finished", "warn", None)
    measured = [check.code for check in checks_of(QaKind.DAILY) if check.code != "treatment_beam_off_ms"]
    assert [one["code"] for one in ended["results"]] == measured, "and there were no treatments"
    noise = next(one for one in ended["results"] if one["code"] == "plate_noise_mm")
    assert (noise["value"], noise["verdict"], noise["warn"], noise["fail"]) == (2.5, "warn", 2.0, 3.0)
    assert [one["code"] for one in ended["series"]] == ["plate_distance", "motion"]
    assert client.get(f"{URL}/runs").json()["items"][0]["id"] == run_id
    assert not rig.job_now.far.is_on()


def test_the_audit_reports_who_began_it_how_it_ended_and_the_hash_of_its_results(client, rig, body):
    rig.report = report(QaKind.DAILY, plate_noise_mm=9.0)
    ended = done(client, rig, body)
    start, end = audit_rows(client, "qa.start")[-1], audit_rows(client, "qa.end")[-1]
    assert (start["actor"], start["outcome"], start["detail"]["run_id"]) == ("A. Physicist", "done", ended["id"])
    assert start["detail"]["request"]["plate"]["source"]["path"] == "plate.oni"
    assert start["detail"]["plate_sha256"] == hashlib.sha256(b"not read by the fake rig").hexdigest()
    assert end["detail"]["verdict"] == "fail"
    assert end["detail"]["not_passed"] == {"plate_noise_mm": "fail"}
    assert end["detail"]["results_sha256"] == ended["sha256"]
    assert client.get("/api/v1/audit/verify").json()["is_intact"]


def changed(body, path, value):
    """Copy a body with one dotted place changed, or removed when the value is `...`."""
    *parents, last = path.split(".")
    copy: dict[str, Any] = dict(body)
    place = copy
    for parent in parents:
        place[parent] = dict(place.get(parent) or {})
        place = place[parent]
    if value is ...:
        place.pop(last, None)
    else:
        place[last] = value
    return copy


BAD = [
    ("kind", ..., "kind"),
    ("kind", "hourly", "kind"),
    ("kind", "daily", "phantom"),
    ("operator", " ", "operator"),
    ("calibration_id", ..., "calibration_id"),
    ("calibration_id", "nothex", "calibration_id"),
    ("calibration_id", "0" * 32, "calibration_id"),
    ("plate", ..., "plate"),
    ("phantom", ..., "phantom"),
    ("surprise", 1, "surprise"),
    ("note", "x" * 501, "note"),
    ("note", "a\nb", "note"),
    ("is_beam_safe", "yes", "is_beam_safe"),
    ("is_beam_safe", 1, "is_beam_safe"),
    ("plate.part", 0.19, "plate.part"),
    ("plate.part", 1.01, "plate.part"),
    ("plate.seconds", 9.9, "plate.seconds"),
    ("plate.seconds", 1801.0, "plate.seconds"),
    ("plate.extra", 1, "plate.extra"),
    ("plate.source", {"kind": "magic"}, "plate.source"),
    ("plate.source.path", "../outside.oni", "plate.source.path"),
    ("plate.source.path", "/etc/passwd", "plate.source.path"),
    ("plate.source.path", "absent.oni", "plate.source.path"),
    ("plate.source.player", "vlc", "plate.source.player"),
    ("phantom.source.path", "absent.oni", "phantom.source.path"),
    ("phantom.trace", "../outside.csv", "phantom.trace"),
    ("phantom.trace", "absent.csv", "phantom.trace"),
    ("phantom.trace", ..., "phantom.trace"),
    ("phantom.window_lower_mm", -100.1, "phantom.window_lower_mm"),
    ("phantom.window_upper_mm", 100.1, "phantom.window_upper_mm"),
    ("phantom.window_upper_mm", -60.0, "phantom.window_lower_mm"),
    ("phantom.window_upper_mm", "5", "phantom.window_upper_mm"),
    ("phantom.starts_us", -1, "phantom.starts_us"),
    ("phantom.starts_us", 3_600_000_001, "phantom.starts_us"),
    ("phantom.seconds", 9.0, "phantom.seconds"),
    ("phantom.extra", 1, "phantom.extra"),
    ("beam.repeats", 4, "beam.repeats"),
    ("beam.repeats", 1001, "beam.repeats"),
    ("beam.repeats", 5.5, "beam.repeats"),
    ("beam.pulse_ms", 119.9, "beam.pulse_ms"),
    ("beam.pulse_ms", 200.1, "beam.pulse_ms"),
    ("beam.extra", 1, "beam.extra"),
    ("simulation", {}, "plate"),
]


def test_a_bad_request_is_refused_with_its_field_and_begins_nothing(client, rig, monthly, subtests):
    for path, value, field in BAD:
        with subtests.test(f"{path}: {str(value)[:24]}"):
            answer = client.post(f"{URL}/runs", json=changed(monthly, path, value))
            assert answer.status_code in {404, 422}, answer.text
            problem = answer.json()
            assert problem["field"] == field
            assert problem["value"]
            assert problem["code"] in {"invalid_value", "not_found"}
            assert rig.jobs == []
    assert client.get(f"{URL}/runs").json()["items"] == []
    refusals = [(row["outcome"], row["detail"]["field"]) for row in audit_rows(client, "qa.start")]
    assert refusals == [("refused", field) for _, _, field in BAD]


BAD_SIMULATIONS = [
    ("simulation.seed", -1),
    ("simulation.seed", 65_536),
    ("simulation.seed", 1.5),
    ("simulation.extra", 1),
    ("simulation.faults.offset_mm", 10.1),
    ("simulation.faults.delay_ms", -1.0),
    ("simulation.faults.delay_ms", 500.1),
    ("simulation.faults.duty_change_percent", 20.1),
    ("simulation.faults.drift_mm_per_min", -10.1),
    ("simulation.faults.extra", 1),
]


@pytest.mark.parametrize(("path", "value"), BAD_SIMULATIONS, ids=str)
def test_a_simulation_out_of_its_bounds_is_refused_with_its_field(client, path, value):
    answer = client.post(f"{URL}/runs", json=changed({"kind": "daily", **ME, "simulation": {}}, path, value))
    assert (answer.status_code, answer.json()["field"]) == (422, path)


@pytest.mark.parametrize("text", ["NaN", "Infinity", "1e999"])
def test_what_is_no_number_is_refused(client, monthly, text):
    content = client.build_request("POST", f"{URL}/runs", json=monthly).content
    content = content.replace(b'"window_upper_mm":5.0', b'"window_upper_mm":' + text.encode())
    answer = client.post(f"{URL}/runs", content=content, headers={"Content-Type": "application/json"})
    assert (answer.status_code, answer.json()["field"]) == (422, "phantom.window_upper_mm")


def test_a_body_that_is_not_json_by_its_type_is_refused(client):
    for method, path in (("POST", "/runs"), ("PUT", "/baseline")):
        answer = client.request(method, f"{URL}{path}", content=b"{}", headers={"Content-Type": "text/plain"})
        assert answer.status_code == 415


def test_one_camera_cannot_see_plate_and_phantom_in_one_request(client, monthly):
    for name in ("plate", "phantom"):
        monthly[name] = monthly[name] | {"source": {"kind": "device"}}
    answer = client.post(f"{URL}/runs", json=monthly)
    assert (answer.status_code, answer.json()["field"]) == (422, "phantom.source.kind")


def test_the_same_key_with_the_same_request_is_one_run(client, rig, body):
    first = client.post(f"{URL}/runs", json=body, headers={"Idempotency-Key": "k1"})
    finish(client, rig, first.json()["id"])
    again = client.post(f"{URL}/runs", json=body, headers={"Idempotency-Key": "k1"})
    assert (again.status_code, again.headers["Idempotency-Replayed"]) == (202, "true")
    assert again.json() == first.json()
    assert len(rig.jobs) == 1
    other = client.post(f"{URL}/runs", json=body | {"note": "other"}, headers={"Idempotency-Key": "k1"})
    assert (other.status_code, other.json()["code"]) == (409, "idempotency_key_reused")


def test_a_second_run_is_refused_while_one_goes_on(client, rig, body):
    run_id = begin(client, body)
    answer = client.post(f"{URL}/runs", json=body)
    assert (answer.status_code, answer.json()["code"], answer.json()["value"]) == (409, "qa_active", f"'{run_id}'")
    finish(client, rig, run_id)
    done(client, rig, body)


def assert_refused_beside(client, rig, body, session_id):
    answer = client.post(f"{URL}/runs", json=body)
    assert (answer.status_code, answer.json()["code"]) == (409, "session_active"), answer.text
    assert (answer.json()["field"], answer.json()["value"]) == ("session_id", f"'{session_id}'")
    assert all(not job.is_on.is_set() for job in rig.jobs)
    assert client.get(f"{URL}/runs").json()["items"] == []


def test_no_run_begins_while_a_session_is_created_runs_or_stops(client, rig, engine, body, session_id, monkeypatch):
    assert_refused_beside(client, rig, body, session_id)
    assert act(client, session_id, "start").status_code == 200
    assert_refused_beside(client, rig, body, session_id)
    stop = engine.running.stop

    def stop_later() -> None:
        assert_refused_beside(client, rig, body, session_id)
        stop()

    monkeypatch.setattr(engine.running, "stop", stop_later)
    act(client, session_id, "stop")
    eventually(lambda: client.get(f"/api/v1/sessions/{session_id}").json()["status"] == "stopped")
    done(client, rig, body)


def test_no_run_begins_while_an_engine_has_the_line_whatever_is_recorded_of_its_session(
    client, rig, body, session_id, running, monkeypatch
):
    monkeypatch.setattr(queries, "open_session_id", lambda _db: None)  # as when its end is stored and it still stops
    assert_refused_beside(client, rig, body, session_id)


def test_no_run_begins_while_a_session_starts(client, rig, engine, body, session_id, monkeypatch):
    started, answers = engine.open, []
    with ThreadPoolExecutor(1) as other:

        def open_slowly(plan):
            answers.append(other.submit(client.post, f"{URL}/runs", json=body))
            return started(plan)

        monkeypatch.setattr(engine, "open", open_slowly)
        assert act(client, session_id, "start").status_code == 200
        assert answers[0].result().json()["code"] == "session_active"
    assert all(not job.is_on.is_set() for job in rig.jobs)


def test_a_session_that_is_created_while_a_run_begins_ends_the_run_before_its_first_pulse(
    client, rig, body, session_body, monkeypatch
):
    """The equipment is taken after the session was allowed and before its row is committed."""
    enter, created = EquipmentSlot.enter_qa, []

    def create_before(slot, run_id):
        created.append(client.post("/api/v1/sessions", json=session_body).json()["id"])
        enter(slot, run_id)

    monkeypatch.setattr(EquipmentSlot, "enter_qa", create_before)
    answer = client.post(f"{URL}/runs", json=body)
    assert (answer.status_code, answer.json()["code"], answer.json()["value"]) == (
        409,
        "session_active",
        f"'{created[0]}'",
    )
    assert all(not job.is_on.is_set() for job in rig.jobs)
    assert client.get(f"{URL}/runs").json()["items"] == []
    assert act(client, created[0], "start").status_code == 200, "the refused run left the equipment"


def test_no_session_begins_and_none_is_made_while_a_run_goes_on(client, rig, engine, body, session_body, monkeypatch):
    run_id = begin(client, body)
    with monkeypatch.context() as earlier:  # a session of which the run did not know
        earlier.setattr(EquipmentSlot, "refuse_qa", lambda _slot: None)
        session_id = client.post("/api/v1/sessions", json=session_body).json()["id"]
    refused = act(client, session_id, "start")
    assert (refused.status_code, refused.json()["code"]) == (409, "qa_active")
    assert engine.opened == []
    act(client, session_id, "stop")
    refused = client.post("/api/v1/sessions", json=session_body)
    assert (refused.status_code, refused.json()["code"]) == (409, "qa_active")
    finish(client, rig, run_id)
    made = client.post("/api/v1/sessions", json=session_body)
    assert act(client, made.json()["id"], "start").status_code == 200


def test_cancelling_holds_the_line_for_good_and_then_ends_the_run(client, rig, body):
    run_id = begin(client, body)
    job = rig.job_now
    eventually(job.is_on.is_set)
    answer = client.post(f"{URL}/runs/{run_id}/cancel", json={"operator": "B. Physicist"})
    assert not job.far.is_on()
    assert (answer.status_code, answer.json()["status"]) == (200, "cancelled")
    assert answer.json()["status_detail"] == "cancelled by B. Physicist"
    assert answer.json()["verdict"] is None
    assert job.far.edges[-1].is_on is False
    assert audit_rows(client, "qa.cancel")[-1]["actor"] == "B. Physicist"
    assert audit_rows(client, "qa.end")[-1]["outcome"] == "failed"
    again = client.post(f"{URL}/runs/{run_id}/cancel", json=ME)
    assert (again.status_code, again.json()["code"]) == (409, "qa_state")
    absent = client.post(f"{URL}/runs/{'0' * 32}/cancel", json=ME)
    assert absent.status_code == 404


def test_a_run_whose_drill_swallows_what_the_line_refuses_is_cancelled_all_the_same(client, rig, body):
    rig.is_stubborn = True
    run_id = begin(client, body)
    job = rig.job_now
    eventually(job.is_on.is_set)
    answer = client.post(f"{URL}/runs/{run_id}/cancel", json=ME)
    assert answer.json()["status"] == "cancelled", "it ends at its next step, not when it is through"
    ended = read(client, run_id)
    assert (ended["status"], ended["verdict"], ended["results"]) == ("cancelled", None, [])
    assert not job.far.is_on()


def test_a_service_that_shuts_down_in_a_run_holds_its_line_and_states_it(settings, engine, rig, calibration_text):
    qa_files(settings.recordings_dirs[0])
    app = create_app(settings, lambda _settings: engine, lambda _settings: rig)
    with PeopleClient(app) as client:
        from tests.support.service.api_calls import upload

        plate = {"source": {"kind": "recording", "path": "plate.oni"}}
        calibration_id = upload(client, calibration_text).json()["id"]
        run_id = begin(client, {"kind": "daily", **ME, "calibration_id": calibration_id, "plate": plate})
        job = rig.job_now
        eventually(job.is_on.is_set)
    assert not job.far.is_on()
    with PeopleClient(create_app(settings, lambda _settings: engine, lambda _settings: rig)) as client:
        assert read(client, run_id)["status"] == "cancelled"


@pytest.mark.parametrize("error", [BeamLineError("the line is gone"), InvalidValueError("trace", 1, "another")])
def test_a_run_that_cannot_go_on_is_failed_and_frees_the_room(client, rig, body, error):
    rig.fail_with = error
    ended = done(client, rig, body)
    assert (ended["status"], ended["verdict"], ended["status_detail"]) == ("failed", None, str(error))
    rig.fail_with = None
    assert done(client, rig, body)["status"] == "finished"


def test_a_rig_that_refuses_leaves_the_room_free(client, rig, body):
    rig.refuse_with = InvalidValueError("plate.part", 3, "less")
    answer = client.post(f"{URL}/runs", json=body)
    assert (answer.status_code, answer.json()["field"]) == (422, "plate.part")
    rig.refuse_with = None
    assert done(client, rig, body)["status"] == "finished"


def test_a_database_that_does_not_take_the_run_begins_nothing_and_leaves_the_room_free(client, rig, body, monkeypatch):
    def locked(*_: object) -> None:
        raise OperationalError("INSERT", {}, Exception("database is locked"))

    with monkeypatch.context() as patched:
        patched.setattr("service.qa.queries.begin", locked)
        assert client.post(f"{URL}/runs", json=body).status_code == 503
    assert not rig.job_now.is_on.is_set()
    assert client.get(f"{URL}/runs").json()["items"] == []
    assert done(client, rig, body)["status"] == "finished"


def test_what_a_killed_program_left_is_interrupted_and_audited_at_the_next_start(settings, engine, rig):
    from datetime import UTC, datetime

    from service.storage.database.engine import Database
    from service.storage.database.tables import QaRunRow

    with PeopleClient(create_app(settings, lambda _settings: engine, lambda _settings: rig)):
        pass
    database = Database(settings.database_place)
    with database.write() as db:
        db.add(
            QaRunRow(
                **dict.fromkeys(("operator", "site", "machine"), "me"),
                **dict.fromkeys(("request", "bounds"), "{}"),
                id="ab" * 16,
                kind="daily",
                is_simulated=False,
                is_simulated_beam=True,
                software="0",
                created_at=datetime.now(UTC),
            )
        )
    database.close()
    with PeopleClient(create_app(settings, lambda _settings: engine, lambda _settings: rig)) as client:
        assert read(client, "ab" * 16)["status"] == "interrupted"
        assert audit_rows(client, "qa.end")[-1]["detail"]["status"] == "interrupted"


def test_lists_are_paged_newest_first(client, rig, body):
    made = [done(client, rig, body)["id"] for _ in range(3)]
    first = client.get(f"{URL}/runs", params={"limit": 2}).json()
    rest = client.get(f"{URL}/runs", params={"limit": 2, "cursor": first["next_cursor"]}).json()
    assert [one["id"] for one in [*first["items"], *rest["items"]]] == made[::-1]
    assert rest["next_cursor"] is None
    assert client.get(f"{URL}/runs", params={"cursor": "x"}).status_code == 422
    assert client.get(f"{URL}/runs/{'0' * 32}").status_code == 404


def test_a_trend_is_in_the_order_of_time_and_leaves_simulated_runs_out(client, rig, body):
    for noise in (1.0, 1.5, None, 2.5):
        rig.report = report(QaKind.DAILY, plate_noise_mm=noise)
        done(client, rig, body)
    rig.report = report(QaKind.DAILY, plate_noise_mm=5.0)
    done(client, rig, {"kind": "daily", **ME, "simulation": {}})
    trend = client.get(f"{URL}/trend", params={"check": "plate_noise_mm"}).json()
    assert [one["value"] for one in trend["items"]] == [1.0, 1.5, None, 2.5]
    assert [one["verdict"] for one in trend["items"]] == ["pass", "pass", "fail", "warn"]
    newest = client.get(f"{URL}/trend", params={"check": "plate_noise_mm", "limit": 2}).json()
    assert [one["value"] for one in newest["items"]] == [None, 2.5]
    for bad in ({"check": "absent"}, {"check": "plate_noise_mm", "limit": 0}, {"check": "A;B"}, {}):
        answer = client.get(f"{URL}/trend", params=bad)
        assert (answer.status_code, answer.json()["code"]) == (422, "invalid_value")


def test_the_checks_are_the_engine_s_with_the_site_s_bounds_and_settings(client):
    items = client.get(f"{URL}/checks").json()["items"]
    assert [one["code"] for one in items] == [check.code for check in CHECKS]
    assert all(one["source"] and one["method"] for one in items)
    assert items[0]["fail_setting"] == "qa.camera_distance_mm_fail"


def test_a_baseline_is_fixed_by_a_named_person_keeps_its_history_and_judges_what_comes(client, rig, body):
    assert client.get(f"{URL}/baseline").json()["number"] == 0
    expected = {"camera_distance_mm": 850.0, "camera_tilt_x_deg": 0.5}
    first = client.put(f"{URL}/baseline", json={**ME, "reason": "commissioning", "expected": expected})
    assert (first.status_code, first.json()["number"], first.json()["expected"]) == (200, 1, expected)
    moved = {"operator": "B. Physicist", "reason": "mounted anew", "expected": {"camera_distance_mm": 900.0}}
    client.put(f"{URL}/baseline", json=moved)
    read_back = client.get(f"{URL}/baseline").json()
    assert (read_back["number"], read_back["expected"]) == (2, expected | {"camera_distance_mm": 900.0})
    assert [one["number"] for one in read_back["earlier"]] == [1]
    row = audit_rows(client, "qa.baseline")[-1]
    assert (row["actor"], row["detail"]["before"], row["detail"]["reason"]) == (
        "B. Physicist",
        expected,
        "mounted anew",
    )
    assert done(client, rig, body)["baseline_number"] == 2
    assert dict(rig.job_now.given[1].expected) == read_back["expected"]


def test_a_baseline_is_taken_over_from_a_finished_run_that_measured_it(client, rig, body):
    rig.report = report(QaKind.DAILY, camera_distance_mm=851.25)
    ended = done(client, rig, body)
    read_back = client.put(f"{URL}/baseline", json={**ME, "reason": "as measured", "run_id": ended["id"]}).json()
    assert read_back["expected"]["camera_distance_mm"] == 851.25
    assert read_back["expected"].keys() == BASELINE_BOUNDS.keys()
    rig.report = report(QaKind.DAILY, camera_distance_mm=None)
    blind = done(client, rig, body)
    refused = client.put(f"{URL}/baseline", json={**ME, "reason": "as measured", "run_id": blind["id"]})
    assert (refused.status_code, refused.json()["field"]) == (422, "run_id")
    rig.report = report(QaKind.DAILY)
    simulated = done(client, rig, {"kind": "daily", **ME, "simulation": {}})
    refused = client.put(f"{URL}/baseline", json={**ME, "reason": "as measured", "run_id": simulated["id"]})
    assert (refused.status_code, refused.json()["field"]) == (422, "run_id")
    assert "simulated" in refused.json()["bound"]
    assert client.get(f"{URL}/baseline").json()["number"] == 1


BAD_BASELINES = [
    ({"operator": " ", "reason": "x", "expected": {"camera_distance_mm": 850.0}}, "operator"),
    ({**ME, "expected": {"camera_distance_mm": 850.0}}, "reason"),
    ({**ME, "reason": "x"}, "expected"),
    ({**ME, "reason": "x", "expected": {}}, "expected"),
    ({**ME, "reason": "x", "expected": {"camera_distance_mm": 299.0}}, "expected.camera_distance_mm"),
    ({**ME, "reason": "x", "expected": {"camera_distance_mm": 3001.0}}, "expected.camera_distance_mm"),
    ({**ME, "reason": "x", "expected": {"camera_tilt_y_deg": 46.0}}, "expected.camera_tilt_y_deg"),
    ({**ME, "reason": "x", "expected": {"plate_noise_mm": 1.0}}, "expected.plate_noise_mm"),
    ({**ME, "reason": "x", "expected": {"camera_distance_mm": 850.0}, "run_id": "0" * 32}, "expected"),
    ({**ME, "reason": "x", "run_id": "0" * 32}, "run_id"),
    ({**ME, "reason": "x", "expected": {"camera_distance_mm": 850.0}, "extra": 1}, "extra"),
]


@pytest.mark.parametrize(("given", "field"), BAD_BASELINES, ids=lambda part: str(part)[-40:])
def test_a_bad_baseline_is_refused_with_its_field_audited_and_changes_nothing(client, given, field):
    answer = client.put(f"{URL}/baseline", json=given)
    assert (answer.status_code in {404, 422}, answer.json()["field"]) == (True, field)
    assert client.get(f"{URL}/baseline").json()["number"] == 0
    assert audit_rows(client, "qa.baseline")[-1]["outcome"] == "refused"


def test_a_baseline_can_be_fixed_for_all_that_the_engine_asks_one_for():
    assert QaExpected.model_fields.keys() == BASELINE_BOUNDS.keys()


def test_no_baseline_is_fixed_while_a_run_goes_on(client, rig, body):
    run_id = begin(client, body)
    given = {**ME, "reason": "x", "expected": {"camera_distance_mm": 850.0}}
    answer = client.put(f"{URL}/baseline", json=given)
    assert (answer.status_code, answer.json()["code"]) == (409, "qa_active")
    finish(client, rig, run_id)


@pytest.fixture
def real(settings, engine, rig, migrated_file) -> Iterator[PeopleClient]:
    """A service on a real beam line."""
    qa_files(settings.recordings_dirs[0])
    line = {"beam_line": "modbus-tcp", "beam_modbus_host": "127.0.0.1"}
    site = with_tables(type(settings)(**settings.model_dump(exclude_unset=True) | line), migrated_file)
    with PeopleClient(create_app(site, lambda _settings: engine, lambda _settings: rig)) as client:
        yield client


@pytest.fixture
def codes(settings) -> OneTimeCodes:
    """The codes of the machine that the service runs on."""
    return OneTimeCodes(settings.data_dir)


@pytest.fixture
def safe_body(real, calibration_text) -> dict[str, Any]:
    calibration_id = upload(real, calibration_text).json()["id"]
    plate = {"source": {"kind": "recording", "path": "plate.oni"}}
    return {"kind": "daily", **ME, "calibration_id": calibration_id, "plate": plate, "is_beam_safe": True}


def assert_refused(client, rig, body, status, code, field, **headers):
    answer = client.post(f"{URL}/runs", json=body, headers=headers)
    assert (answer.status_code, answer.json()["code"], answer.json()["field"]) == (status, code, field), answer.text
    assert all(not job.is_on.is_set() for job in rig.jobs)
    assert client.get(f"{URL}/runs").json()["items"] == []
    return answer.json()


def test_the_real_line_is_permitted_only_on_the_operator_s_word(real, rig, codes, safe_body):
    code = codes.make(ME["operator"])
    assert_refused(real, rig, safe_body | {"is_beam_safe": False, "code": code}, 422, "invalid_value", "is_beam_safe")
    assert rig.jobs == []
    assert done(real, rig, safe_body | {"code": code})["is_simulated_beam"] is False
    assert audit_rows(real, "qa.start")[-1]["detail"]["request"]["is_beam_safe"] is True


def test_the_real_line_is_permitted_only_with_a_code_from_the_machine_and_once(real, rig, codes, safe_body):
    assert_refused(real, rig, safe_body, 403, "qa_code", "code")
    assert_refused(real, rig, safe_body | {"code": "2222-2222"}, 403, "qa_code", "code")
    code = codes.make(ME["operator"])
    assert done(real, rig, safe_body | {"code": code})["status"] == "finished"
    again = real.post(f"{URL}/runs", json=safe_body | {"code": code})
    assert (again.status_code, again.json()["code"]) == (403, "qa_code")
    assert len(real.get(f"{URL}/runs").json()["items"]) == 1


def test_a_code_of_another_person_opens_nothing(real, rig, codes, safe_body):
    assert_refused(real, rig, safe_body | {"code": codes.make("B. Physicist")}, 403, "qa_code", "code")


def test_a_code_is_in_no_record_and_the_audit_states_when_it_was_made(real, rig, codes, safe_body, settings):
    wrong = "3333-4444"
    assert_refused(real, rig, safe_body | {"code": wrong}, 403, "qa_code", "code")
    code = codes.make(ME["operator"])
    done(real, rig, safe_body | {"code": code})
    rows = audit_rows(real)
    assert not any(one in str(rows) for one in (wrong, code, "33334444", code.replace("-", "")))
    detail = next(row["detail"] for row in rows if row["action"] == "qa.start" and row["outcome"] == "done")
    assert detail["request"]["code_made_at"]
    assert "code" not in detail["request"]


@pytest.mark.parametrize("code", ["", "2" * 33, 22222222], ids=["empty", "long", "a number"])
def test_a_code_out_of_its_bound_is_refused_with_its_field(real, rig, safe_body, code):
    assert_refused(real, rig, safe_body | {"code": code}, 422, "invalid_value", "code")


def test_a_replayed_answer_needs_no_second_code(real, rig, codes, safe_body):
    first = real.post(
        f"{URL}/runs", json=safe_body | {"code": codes.make(ME["operator"])}, headers={"Idempotency-Key": "k"}
    )
    finish(real, rig, first.json()["id"])
    again = real.post(f"{URL}/runs", json=safe_body, headers={"Idempotency-Key": "k"})
    assert (again.status_code, again.headers["Idempotency-Replayed"]) == (202, "true")
    assert len(rig.jobs) == 1


def test_what_is_refused_otherwise_leaves_the_code(real, rig, codes, safe_body):
    code = codes.make(ME["operator"])
    absent = {"source": {"kind": "recording", "path": "absent.oni"}}
    assert_refused(real, rig, safe_body | {"code": code, "plate": absent}, 404, "not_found", "plate.source.path")
    wanted = make_session_body(safe_body["calibration_id"]) | {"source": {"kind": "device"}}
    session = real.post("/api/v1/sessions", json=wanted).json()["id"]
    assert_refused(real, rig, safe_body | {"code": code}, 409, "session_active", "session_id")
    act(real, session, "stop")
    done(real, rig, safe_body | {"code": code})


@pytest.mark.parametrize("simulation", [None, {"seed": 1}], ids=["simulated line", "simulated run"])
def test_pulses_to_nothing_need_no_code_and_take_none(client, rig, body, simulation):
    wanted = body if simulation is None else {"kind": "daily", **ME, "simulation": simulation}
    refused = client.post(f"{URL}/runs", json=wanted | {"code": "2222-2222"})
    assert (refused.status_code, refused.json()["field"]) == (422, "code")
    done(client, rig, wanted)


def bearer_of(client, scopes) -> dict[str, str]:
    until = client.desk.store.now() + timedelta(days=1)
    made = client.desk.keys.create("planning", scopes, until, by="test")
    return {"Authorization": f"Bearer {made.secret}"}


def test_no_key_begins_a_run_whatever_it_has(real, rig, codes, safe_body):
    key = bearer_of(real, KEY_PERMISSIONS)
    body = safe_body | {"code": codes.make(ME["operator"])}
    (stored,) = real.desk.store.keys.values()
    for scopes in (KEY_PERMISSIONS, frozenset(Permission)):
        real.desk.store.keys[stored.id] = replace(stored, scopes=scopes)
        assert_refused(real, rig, body, 403, "permission_missing", "permission", **key)
    assert rig.jobs == []


@pytest.mark.parametrize("role", sorted(set(Role) - {Role.PHYSICIST}))
def test_no_role_but_the_physicist_begins_a_run(real, rig, codes, safe_body, role):
    real.headers_as("Somebody", [role])
    body = safe_body | {"operator": "Somebody", "code": codes.make("Somebody")}
    assert_refused(real, rig, body, 403, "permission_missing", "permission")
    assert rig.jobs == []


def test_a_physicist_alone_begins_a_run(real, rig, codes, safe_body):
    real.headers_as("Somebody", [Role.PHYSICIST])
    done(real, rig, safe_body | {"operator": "Somebody", "code": codes.make("Somebody")})


def test_anyone_who_may_take_the_beam_away_may_cancel_a_run(client, rig, body):
    key = bearer_of(client, [Permission.GATE_HOLD])
    run_id = begin(client, body)
    eventually(rig.job_now.is_on.is_set)
    answer = client.post(f"{URL}/runs/{run_id}/cancel", json=ME, headers=key)
    assert (answer.status_code, answer.json()["status"]) == (200, "cancelled")


def test_a_run_names_site_and_machine_and_carries_no_patient(client, rig, body):
    ended = done(client, rig, body)
    assert {"site", "machine", "operator", "software"} <= ended.keys()
    assert not {"patient_reference", "plan_id"} & ended.keys()
    assert OPERATOR["operator"] != ended["operator"]


def test_a_run_that_is_being_written_down_while_the_service_holds_the_beam_for_its_end_drills_nothing(
    client, rig, body, monkeypatch
):
    write_down = records.begin

    def asked_to_stop_meanwhile(db, run):
        row = write_down(db, run)
        stopping = threading.Thread(target=client.app.state.hold_and_close_session)
        stopping.start()
        stopping.join()
        return row

    monkeypatch.setattr(records, "begin", asked_to_stop_meanwhile)
    run_id = begin(client, body)
    eventually(lambda: read(client, run_id)["status"] == "cancelled")
    assert not rig.job_now.is_on.is_set()


def test_nothing_begins_any_more_once_the_service_is_on_its_way_out(client, rig, body, calibration_id):
    session_id = client.post("/api/v1/sessions", json=make_session_body(calibration_id)).json()["id"]
    client.app.state.hold_and_close_session()
    for answer in (client.post(f"{URL}/runs", json=body), act(client, session_id, "start")):
        assert (answer.status_code, answer.json()["code"]) == (503, "service_stopping")


def test_its_cancelling_is_answered_while_reads_have_every_thread_and_connection(client, rig, body, monkeypatch):
    run_id = begin(client, body)
    eventually(rig.job_now.is_on.is_set)
    with reads(client, THREADS + 5) as (jam, pool):
        monkeypatch.setattr(queries, "session_page", jam.rows)
        ask_for_lists(client, pool, THREADS + 5)
        eventually(lambda: jam.inside == CONNECTIONS and waiting_for_a_thread(client) == 5, within_s=LONGEST_S)
        answer = pool.submit(client.post, f"{URL}/runs/{run_id}/cancel", json=ME).result(LONGEST_S)
        assert (answer.status_code, answer.json()["status"]) == (200, "cancelled"), answer.text
        assert not rig.job_now.far.is_on()
        assert jam.inside == CONNECTIONS, "they were blocked all the time"
