"""The holds of the treatments in QA: each time to beam off since the last run, judged, in the report and its trend."""

from collections.abc import Iterator
from datetime import UTC, datetime

import pytest

from engine.beam.beam_on import BeamOff, BeamOnState
from engine.core.errors import BeamLineError
from engine.qa.results import QaKind, QaReport
from service.storage.database.engine import Database
from service.web.app import create_app
from tests.support.database.migrated import with_tables
from tests.support.qa.fake_rig import FakeRig, qa_files
from tests.support.qa.latency_runs import put
from tests.support.qa.sample_runs import report
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import act, audit_rows
from tests.support.waiting import eventually

pytestmark = pytest.mark.both_databases

CODE = "treatment_beam_off_ms"
URL = "/api/v1/qa"


def measured() -> QaReport:
    """A passed run that knows nothing of treatments."""
    whole = report(QaKind.DAILY)
    return QaReport(kind=whole.kind, results=tuple(one for one in whole.results if one.code != CODE))


@pytest.fixture
def rig() -> FakeRig:
    rig = FakeRig()
    rig.report = measured()
    rig.go_on.set()
    return rig


@pytest.fixture
def client(settings, engine, rig: FakeRig, migrated_file) -> Iterator[PeopleClient]:
    qa_files(settings.recordings_dirs[0])
    with_tables(settings, migrated_file)
    with PeopleClient(create_app(settings, lambda _settings: engine, lambda _settings: rig)) as client:
        yield client


@pytest.fixture
def treat(client, session_body, engine):
    """Run a session whose holds took so long to the beam off [ms]."""

    def one(*offs_ms: float) -> None:
        session_id = client.post("/api/v1/sessions", json=session_body).json()["id"]
        act(client, session_id, "start")
        before = len(audit_rows(client, "beam.off"))
        offs = (BeamOff(number=number, ended_ns=number, off_ms=off_ms) for number, off_ms in enumerate(offs_ms, 1))
        engine.running.beam_on = BeamOnState(newest_offs=tuple(offs))
        engine.running.frame()
        eventually(lambda: len(audit_rows(client, "beam.off")) == before + len(offs_ms))
        act(client, session_id, "stop")

    return one


@pytest.fixture
def run_qa(client, calibration_id):
    body = {
        "kind": "daily",
        "operator": "A. Physicist",
        "calibration_id": calibration_id,
        "plate": {"source": {"kind": "recording", "path": "plate.oni"}},
    }

    def run() -> dict:
        run_id = client.post(f"{URL}/runs", json=body).json()["id"]
        eventually(lambda: client.get(f"{URL}/runs/{run_id}").json()["status"] != "running")
        return client.get(f"{URL}/runs/{run_id}").json()

    return run


def result_of(run: dict) -> dict | None:
    return next((one for one in run["results"] if one["code"] == CODE), None)


def test_the_holds_since_the_last_run_are_a_check_of_the_next_one_and_in_its_trend(client, treat, run_qa):
    treat(40.0, 50.0, 60.0)
    treat(45.0)
    first = run_qa()
    found = result_of(first)
    assert found["value"] == pytest.approx(58.5)
    assert found["verdict"] == "pass"
    assert found["detail"] == "4 holds in 2 sessions since the last run: median 47.5 ms, slowest 60.0 ms"
    treat(120.0)
    second = run_qa()
    assert (result_of(second)["value"], result_of(second)["verdict"]) == (120.0, "warn")
    assert second["verdict"] == "warn"
    trend = client.get(f"{URL}/trend", params={"check": CODE}).json()
    assert [one["value"] for one in trend["items"]] == [pytest.approx(58.5), 120.0]
    assert client.get(f"{URL}/runs/{second['id']}/report.pdf").content.startswith(b"%PDF")


def test_slow_holds_fail_the_run(treat, run_qa):
    treat(170.0, 170.0)
    run = run_qa()
    assert (result_of(run)["verdict"], run["verdict"]) == ("fail", "fail")


def test_without_a_hold_that_was_measured_the_check_is_left_out(treat, run_qa):
    treat()
    run = run_qa()
    assert result_of(run) is None
    assert run["verdict"] == "pass"


def test_sessions_of_the_other_kind_of_line_do_not_count(treat, run_qa, engine):
    engine.is_simulated_beam = False
    treat(170.0)
    assert result_of(run_qa()) is None


def test_a_run_that_was_not_finished_does_not_end_the_time_that_the_next_one_covers(treat, run_qa, rig):
    treat(55.0)
    rig.fail_with = BeamLineError("cut")
    assert run_qa()["status"] == "failed"
    rig.fail_with = None
    assert result_of(run_qa())["value"] == 55.0


def test_a_latency_run_does_not_end_the_time_that_the_next_one_covers(treat, run_qa, settings):
    """It has no figure of the treatments."""
    treat(55.0)
    database = Database(settings.database_place)
    put(database, now=datetime.now(UTC), age_days=0.0)
    database.close()
    assert result_of(run_qa())["value"] == 55.0
