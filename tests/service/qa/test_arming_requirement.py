"""A daily QA that is overdue, failed or not finished: no one arms, and everybody is notified why."""

import json
from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime, timedelta

import pytest

from engine.core.commands import Arm
from engine.qa.bounds import QaBounds
from engine.qa.checks import CHECKS
from engine.qa.results import QaKind
from service.core.settings.settings import Settings
from service.qa import queries
from service.qa.arming_requirement import refusal
from service.storage.database.engine import Database
from service.storage.database.tables import QaOutcomeRow, QaResultRow, QaRunRow
from service.web.app import create_app
from tests.support.database.migrated import with_tables
from tests.support.qa.fake_rig import FakeRig
from tests.support.qa.sample_runs import report
from tests.support.service.accounts import PeopleClient
from tests.support.service.api_calls import act, audit_rows

pytestmark = pytest.mark.both_databases

NOW = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)
DAY = Settings(qa_required_daily_h=24.0)


def bounds_of(settings, **other):
    """The bounds a run keeps, by the site's settings; some of them others."""
    return {check.code: asdict(settings.qa_bounds.of(check.code)) for check in CHECKS} | other


def put(
    database,
    *,
    age_h=1.0,
    status="finished",
    verdict="pass",
    kind="daily",
    is_simulated=False,
    now=NOW,
    plate=None,
    place=DAY.beam_place,
    bounds=None,
):
    """Write a run down as it would have been so long ago; ``status`` None leaves it without an end."""
    began = now - timedelta(hours=age_h)
    run_id = f"{abs(hash((age_h, status, verdict, kind, is_simulated, str(place), str(bounds)))):032x}"[:32]
    with database.write() as db:
        db.add(
            QaRunRow(
                **dict.fromkeys(("operator", "site", "machine"), "me"),
                request=json.dumps({"beam_place": place}),
                bounds=json.dumps(bounds_of(DAY) if bounds is None else bounds),
                id=run_id,
                kind=kind,
                is_simulated=is_simulated,
                is_simulated_beam=True,
                plate_sha256=plate,
                software="0",
                created_at=began,
            )
        )
        db.flush()
        if verdict == "fail":
            numbers = {"position": 0, "value": 9.0, "warn": 2.0, "fail": 3.0}
            db.add(QaResultRow(run_id=run_id, code="plate_noise_mm", unit="mm", verdict="fail", detail="", **numbers))
            db.flush()
        if status is not None:
            ended = {"verdict": verdict, "series": "[]", "sha256": "", "ended_at": began}
            db.add(QaOutcomeRow(run_id=run_id, status=status, status_detail="", **ended))


def why(database, settings=DAY, now=NOW):
    with database.read() as db:
        return refusal(db, settings, now)


def test_a_site_that_does_not_ask_lets_everybody_arm(database):
    put(database, verdict="fail")
    assert why(database, Settings()) is None


def test_without_any_qa_arming_is_refused(database):
    assert "none was ever done" in why(database)


@pytest.mark.parametrize("kind", ["daily", "monthly", "annual"])
@pytest.mark.parametrize("verdict", ["pass", "warn"])
def test_a_young_qa_of_any_kind_that_did_not_fail_lets_people_arm(database, kind, verdict):
    put(database, kind=kind, verdict=verdict)
    assert why(database) is None


@pytest.mark.parametrize(("age_h", "is_allowed"), [(23.99, True), (24.0, True), (24.01, False), (700.0, False)])
def test_it_lasts_as_long_as_the_site_states(database, age_h, is_allowed):
    put(database, age_h=age_h)
    reason = why(database)
    assert (reason is None) is is_allowed
    if reason is not None:
        assert "requires one every 24 h" in reason


def test_one_that_is_yet_to_come_counts_for_nothing(database):
    put(database, age_h=-0.5)
    assert "check this machine's clock" in why(database)


@pytest.mark.parametrize("kind", ["daily", "monthly", "annual"])
def test_a_failed_one_holds_until_a_newer_one_is_passed(database, kind):
    put(database, age_h=3.0)
    put(database, age_h=2.0, verdict="fail", kind=kind)
    assert "failed (plate_noise_mm)" in why(database)
    put(database, age_h=1.0)
    assert why(database) is None


@pytest.mark.parametrize("status", ["cancelled", "failed", "interrupted", None])
def test_one_that_was_begun_and_not_finished_is_no_pass_and_hides_the_one_before(database, status):
    put(database, age_h=2.0)
    put(database, age_h=1.0, status=status, verdict=None)
    reason = why(database)
    assert reason is not None
    assert (status or "has not ended") in reason


def test_a_recording_judged_again_is_as_old_as_when_it_was_first_judged(database):
    put(database, age_h=30.0, plate="f00d")
    put(database, age_h=1.0, plate="f00d")
    assert "recording was judged on 2026-11-20 06:00 UTC already" in why(database)
    put(database, age_h=0.5, plate="cafe")
    assert why(database) is None
    put(database, age_h=0.2, plate="cafe", kind="monthly")
    assert why(database) is None


def test_simulated_runs_count_for_nothing_either_way(database):
    put(database, age_h=1.0, is_simulated=True)
    assert "none was ever done" in why(database)
    put(database, age_h=2.0)
    put(database, age_h=0.5, verdict="fail", is_simulated=True)
    assert why(database) is None


REAL = {"beam_line": "modbus-tcp", "beam_modbus_host": "10.0.0.1"}


def test_a_run_on_a_simulated_line_states_nothing_of_a_real_one(database):
    """The command's own line is simulated, and asks for no one's word."""
    real = Settings(qa_required_daily_h=24.0, **REAL)
    put(database)
    assert "another beam line (simulated) than this service's (modbus-tcp, 10.0.0.1, 502" in why(database, real)
    put(database, age_h=0.5, place=real.beam_place)
    assert why(database, real) is None
    assert "another beam line" in why(database)


def test_a_run_on_a_real_line_elsewhere_states_nothing_of_this_one(database):
    real = Settings(qa_required_daily_h=24.0, **REAL)
    put(database, place=Settings(**{**REAL, "beam_modbus_host": "10.9.9.9"}).beam_place)
    assert "10.9.9.9" in why(database, real)
    put(database, age_h=0.5, place=None)
    assert "unknown" in why(database, real)


def test_a_run_by_wider_bounds_than_the_site_s_is_none_of_it(database):
    put(database, bounds=bounds_of(DAY, camera_distance_mm={"warn": 5.0, "fail": 5.0}))
    assert "wider bounds than this service's (camera_distance_mm)" in why(database)
    put(database, age_h=0.8, bounds={})
    assert "none stored" in why(database)
    put(database, age_h=0.5, bounds=bounds_of(DAY, camera_distance_mm={"warn": 0.1, "fail": 0.2}))
    assert why(database) is None


def test_a_run_of_before_the_heartbeat_s_drill_lets_no_one_arm(database):
    earlier = {code: bound for code, bound in bounds_of(DAY).items() if code != "fail_safe_heartbeat_ms"}
    put(database, bounds=earlier)
    assert "did not include fail_safe_heartbeat_ms, which the daily QA has now" in why(database)
    put(database, age_h=0.5)
    assert why(database) is None


@pytest.fixture
def strict(settings) -> Settings:
    return Settings(**settings.model_dump(exclude_unset=True), qa_required_daily_h=24.0)


@pytest.fixture
def client(strict, engine, migrated_file) -> Iterator[PeopleClient]:
    with PeopleClient(
        create_app(with_tables(strict, migrated_file), lambda _settings: engine, lambda _settings: FakeRig())
    ) as client:
        yield client


def test_arming_without_it_is_refused_before_the_engine_and_audited_with_the_reason(
    client, strict, running, session_id
):
    refused = act(client, session_id, "arm")
    assert (refused.status_code, refused.json()["code"]) == (409, "qa_overdue")
    assert "tidegate qa daily" in refused.json()["detail"]
    assert not any(isinstance(command, Arm) for command in running.commands)
    row = audit_rows(client, "session.arm")[-1]
    assert (row["outcome"], row["detail"]["code"]) == ("refused", "qa_overdue")
    for harmless in ("disarm", "hold", "release", "reference"):
        assert act(client, session_id, harmless).status_code == 200, harmless
    ready = client.get("/readyz")
    assert ready.status_code == 503
    assert any("this site asks for a QA" in one for one in ready.json()["not_ready"])
    answer = client.get("/api/v1/qa/status").json()
    assert (answer["is_arming_allowed"], answer["required_daily_h"]) == (False, 24.0)
    assert "none was ever done" in answer["refusal"]


def test_with_it_people_arm_and_the_service_is_ready(client, strict, running, session_id):
    database = Database(strict.database_place)
    put(database, now=datetime.now(UTC))
    database.close()
    assert act(client, session_id, "arm").status_code == 200
    assert client.get("/readyz").status_code == 200
    answer = client.get("/api/v1/qa/status").json()
    assert (answer["is_arming_allowed"], answer["refusal"]) == (True, None)
    assert answer["newest"]["daily"]["verdict"] == "pass"
    assert answer["newest"]["monthly"] is None


def test_what_is_written_of_a_run_is_what_the_requirement_reads(database):
    """The rows of a test are those of a run: begun and ended as the service does."""
    made = report(QaKind.DAILY, plate_noise_mm=9.0)
    begin = queries.NewQaRun(
        kind=QaKind.DAILY,
        operator="me",
        request={"beam_place": DAY.beam_place},
        site="",
        machine="",
        bounds=QaBounds(),
        is_simulated=False,
        is_simulated_beam=True,
    )
    with database.write() as db:
        queries.begin(db, begin)
    assert "has not ended" in why(database, now=datetime.now(UTC) + timedelta(seconds=5))
    with database.write() as db:
        queries.end(db, begin.run_id, queries.QaOutcome(status="finished", report=made))
    assert "failed (plate_noise_mm)" in why(database, now=datetime.now(UTC) + timedelta(seconds=5))
