"""`/readyz`: what is missing, by codes that stay; asked often it costs nothing, and it never hangs for long."""

import shutil
import sqlite3
import threading
import time
from collections import namedtuple
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import text
from sqlalchemy.exc import OperationalError

from service.core.periodic import PeriodicWorker
from service.core.schemas.base import ReadinessCode
from service.core.settings.settings import Settings
from service.monitoring import readiness as module
from service.monitoring.certificate import ServedCertificate
from service.monitoring.readiness import LONGEST_AGE_MS, ReadinessProbe
from tests.support.access.tls_certificate import make_certificate
from tests.support.waiting import eventually

Usage = namedtuple("Usage", "total used free")


class HandClock:
    """A clock that a test sets."""

    def __init__(self):
        self.ns = 1_000_000_000_000

    def now_ns(self):
        return self.ns

    def go_on(self, ms):
        self.ns += round(ms * 1_000_000)


@pytest.fixture
def probe_of(database, tmp_path, monkeypatch):
    database.migrate()

    def make(*, clock=None, now=None, kept_ms=0.0, **settings):
        monkeypatch.setattr(module, "KEPT_MS", kept_ms)
        looks = {name: settings.pop(name) for name in list(settings) if name in LOOKS}
        return ReadinessProbe(
            database,
            Settings(data_dir=tmp_path, **{**OUTSIDE, **settings}),
            looks.pop("audit_troubles", list),
            **{"has_camera_runtime": lambda: True, "clock": clock, **({"now": now} if now else {}), **looks},
        )

    return make


OUTSIDE = {"audit_anchor_file": Path("/another/machine/anchors.jsonl")}
LOOKS = ("audit_troubles", "ended_threads", "engine_trouble", "is_stopping", "has_camera_runtime", "certificate")


def codes(reasons):
    return [reason.code for reason in reasons]


def test_where_nothing_is_missing_it_is_ready_and_states_when_it_looked(probe_of):
    before = datetime.now(UTC)
    found = probe_of().readiness()
    assert (found.is_ready, found.not_ready, found.reasons, found.warnings) == (True, [], [], [])
    assert before <= found.checked_at <= datetime.now(UTC)


@pytest.mark.parametrize("where", ["heads.jsonl", "below/heads.jsonl", "../elsewhere/../{}/heads.jsonl"])
def test_anchors_in_the_data_folder_are_a_warning(probe_of, tmp_path, where):
    found = probe_of(audit_anchor_file=tmp_path / where.format(tmp_path.name)).readiness()
    assert (found.is_ready, codes(found.warnings)) == (True, [ReadinessCode.ANCHORS_INSIDE])


@pytest.mark.parametrize(
    ("look", "code"),
    [
        ({"audit_troubles": lambda: ["the audit's heads cannot be kept"]}, ReadinessCode.AUDIT_TROUBLE),
        ({"ended_threads": lambda: ["armed-operator"]}, ReadinessCode.THREAD_ENDED),
        ({"engine_trouble": lambda: "the engine's process does not start"}, ReadinessCode.ENGINE_MISSING),
        ({"is_stopping": lambda: True}, ReadinessCode.SERVICE_STOPPING),
        ({"qa_required_daily_h": 24.0}, ReadinessCode.QA_OVERDUE),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_missing_has_a_code_and_a_sentence(probe_of, look, code):
    found = probe_of(**look).readiness()
    assert not found.is_ready
    assert codes(found.reasons) == [code]
    assert found.not_ready == [found.reasons[0].detail]


def test_a_full_disk_and_a_missing_folder_have_theirs(probe_of, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: Usage(10**12, 10**12, 5 * 1024 * 1024))
    found = probe_of(recordings_dirs=(tmp_path / "nowhere",)).readiness()
    assert codes(found.reasons) == [ReadinessCode.DISK_LOW, ReadinessCode.RECORDINGS_MISSING]
    assert "5 MiB" in found.not_ready[0]


def test_a_database_that_takes_nothing_has_its_own_and_its_message_is_not_reported(probe_of, database, monkeypatch):
    def refuse():
        raise OperationalError("INSERT 'P-0001'", {}, Exception("P-0001"))

    monkeypatch.setattr(database, "write", refuse)
    found = probe_of().readiness()
    assert codes(found.reasons) == [ReadinessCode.DATABASE_UNWRITABLE]
    assert "P-0001" not in found.model_dump_json()


def test_a_missing_camera_runtime_is_a_warning_in_research_and_a_reason_in_the_clinic(probe_of):
    found = probe_of(has_camera_runtime=lambda: False).readiness()
    assert (found.is_ready, codes(found.warnings)) == (True, [ReadinessCode.CAMERA_RUNTIME_MISSING])
    probe = probe_of(has_camera_runtime=lambda: False)
    probe._settings = probe._settings.model_copy(update={"mode": "clinical"})
    found = probe.readiness()
    reasons = [ReadinessCode.CAMERA_LATENCY, ReadinessCode.CAMERA_RUNTIME_MISSING]
    assert (codes(found.reasons), codes(found.warnings)) == (reasons, [])
    assert "no camera's latency was ever measured: measure it (tidegate qa latency" in found.not_ready[0]


@pytest.mark.parametrize(
    ("later", "reasons", "warnings"),
    [
        (timedelta(), [], [ReadinessCode.CERTIFICATE_ENDS_SOON]),
        (timedelta(days=2), [ReadinessCode.CERTIFICATE_ENDED], []),
        (-timedelta(days=40), [], []),
    ],
    ids=["soon", "over", "long"],
)
def test_a_certificate_is_warned_of_before_it_ends_and_missed_after(probe_of, tmp_path, later, reasons, warnings):
    certificate = ServedCertificate(*make_certificate(tmp_path))
    found = probe_of(certificate=certificate, now=lambda: datetime.now(UTC) + later).readiness()
    assert (codes(found.reasons), codes(found.warnings)) == (reasons, warnings)


def test_a_new_certificate_that_cannot_be_used_is_a_warning_while_the_one_before_is_served(probe_of, tmp_path):
    cert, key = make_certificate(tmp_path, ends_in=timedelta(days=300))
    certificate = ServedCertificate(cert, key)
    probe = probe_of(certificate=certificate)
    assert probe.readiness().warnings == []
    cert.write_text("not a certificate")
    certificate.look()
    found = probe.readiness()
    assert (found.is_ready, codes(found.warnings)) == (True, [ReadinessCode.CERTIFICATE_UNREADABLE])
    assert str(cert) in found.warnings[0].detail
    assert f"{certificate.ends_at:%Y-%m-%d}" in found.warnings[0].detail
    make_certificate(tmp_path, ends_in=timedelta(days=300))
    certificate.look()
    assert probe.readiness().warnings == []


def test_a_wall_clock_behind_the_audit_is_a_warning(database, probe_of):
    from service.storage.audit import SYSTEM, Event
    from service.storage.audit.log import AuditLog

    database.migrate()
    AuditLog(database).write(Event(actor=SYSTEM, action="service.start"))
    found = probe_of(now=lambda: datetime.now(UTC) - timedelta(hours=1)).readiness()
    assert (found.is_ready, codes(found.warnings)) == (True, [ReadinessCode.CLOCK_BEHIND])


def test_asked_often_it_looks_once(probe_of, database, monkeypatch):
    clock, writes = HandClock(), []
    write = database.write
    monkeypatch.setattr(database, "write", lambda: writes.append(1) or write())
    probe = probe_of(kept_ms=1_000.0, clock=clock)
    for _ in range(50):
        probe.readiness()
        clock.go_on(ms=19.0)
    assert len(writes) == 1
    clock.go_on(ms=100.0)
    probe.readiness()
    assert len(writes) == 2


def test_the_way_out_is_reported_at_once_whatever_was_kept(probe_of):
    stopping = threading.Event()
    probe = probe_of(kept_ms=10_000.0, is_stopping=stopping.is_set)
    assert probe.readiness().is_ready
    stopping.set()
    assert codes(probe.readiness().reasons) == [ReadinessCode.SERVICE_STOPPING]


def test_while_a_check_hangs_the_previous_result_is_returned_and_then_not_known(probe_of):
    clock, go_on, hangs = HandClock(), threading.Event(), threading.Event()

    def troubles():
        if hangs.is_set():
            assert go_on.wait(20.0)
        return []

    probe = probe_of(kept_ms=1_000.0, clock=clock, audit_troubles=troubles)
    first = probe.readiness()
    hangs.set()
    clock.go_on(ms=1_500.0)
    hanging = threading.Thread(target=probe.readiness)
    hanging.start()
    eventually(probe._probing.locked)
    asked_s = time.monotonic()
    assert probe.readiness() is first
    clock.go_on(ms=LONGEST_AGE_MS)
    found = probe.readiness()
    assert codes(found.reasons) == [ReadinessCode.NOT_KNOWN]
    assert time.monotonic() - asked_s < 2.0, "who asks waits for the look that hangs"
    go_on.set()
    hanging.join()
    assert probe.readiness().is_ready


def test_the_runtime_is_looked_for_once(probe_of):
    asked = []
    probe = probe_of(has_camera_runtime=lambda: asked.append(1) or True)
    probe.readiness()
    probe.readiness()
    assert len(asked) == 1


def test_every_code_there_is_can_be_come_to():
    source = (module.__file__ or "").replace(".pyc", ".py")
    with open(source, encoding="utf-8") as file:  # noqa: PTH123 - the module's own file
        text = file.read()
    assert [code.name for code in ReadinessCode if f"ReadinessCode.{code.name}" not in text] == []


def test_unknown_callers_get_only_the_health(client):
    client.speaks_as = None
    try:
        assert client.get("/healthz").json() == {"status": "ok"}
        answer = client.get("/readyz")
        assert answer.status_code == 401
        assert "reasons" not in answer.text
    finally:
        client.speaks_as = "A. Therapist"


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_thread_that_died_is_missed(client, monkeypatch):
    def turn():
        raise ValueError

    worker = PeriodicWorker("armed-operator", turn, interval_s=0.0)
    monkeypatch.setattr(client.app.state.armed_operator, "_worker", worker)
    worker.start()
    eventually(lambda: worker.has_ended)
    answer = client.get("/readyz")
    assert (answer.status_code, answer.json()["reasons"][0]["code"]) == (503, "thread_ended")
    assert "armed-operator" in answer.json()["not_ready"][0]


def test_anchors_that_lie_beside_the_audit_are_a_warning(probe_of):
    found = probe_of(audit_anchor_file=None).readiness()
    assert (found.is_ready, codes(found.warnings)) == (True, [ReadinessCode.ANCHORS_INSIDE])


def test_a_write_ahead_log_that_grows_beside_a_reader_is_a_warning_and_shrinks_when_it_has_gone(
    database, probe_of, monkeypatch
):
    monkeypatch.setattr("service.monitoring.readiness.MOST_LOG_MB", 20.0)
    database.migrate()

    def write(rows):
        for number in range(rows):
            with database.write() as db:
                db.execute(text("CREATE TABLE IF NOT EXISTS big (value TEXT)"))
                db.execute(text("INSERT INTO big VALUES (:value)"), {"value": f"{number}" * 500_000})

    with sqlite3.connect(database.path) as reader:
        reader.execute("BEGIN")
        reader.execute("SELECT count(*) FROM sqlite_master").fetchone()
        write(60)
        assert codes(probe_of().readiness().warnings) == [ReadinessCode.DATABASE_LOG_LARGE]
        reader.rollback()
    write(8)
    write(8)
    assert probe_of().readiness().warnings == []
    assert database.log_bytes() <= 17 * 1024 * 1024
