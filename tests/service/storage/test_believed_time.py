"""Nothing that cannot be undone happens on the word of a clock that disagrees with the records."""

from datetime import timedelta

import pytest

from engine.core.clock import ManualClock
from service.core.settings.settings import Settings
from service.storage import audit
from service.storage.audit import SYSTEM, Event
from service.storage.audit.check import clock_went_back
from service.storage.believed_time import BelievedTime, latest_time
from service.storage.files.cleanup import CleanupWorker
from tests.support.samples.sessions import BEGUN, add_session

SESSION, LATER = "0" * 32, "1" * 32
NOW = BEGUN + timedelta(days=31)
HOUR_NS = 3_600 * 10**9


class Machine:
    """A wall clock that a test sets, run time, and the worker that removes."""

    def __init__(self, database, folder, now):
        self.now, self.clock, self.database = now, ManualClock(), database
        self.time = BelievedTime(database, now=lambda: self.now, clock=self.clock)
        self.time.start()
        settings = Settings(data_dir=folder, retain_samples_days=30)
        self.worker = CleanupWorker(database, settings, is_busy=lambda: False, time=self.time)

    def runs(self, span):
        self.now += span
        self.clock.advance_ns(int(span.total_seconds() * 1e9))

    def removed(self):
        return [one.path.name for one in self.worker.tidy()]


@pytest.fixture
def folder(tmp_path, database):
    """A session of 31 days ago, with the rows that the service wrote then and yesterday."""
    database.migrate()
    place = tmp_path / "data"
    (place / "samples").mkdir(parents=True)
    ended_session(database, place, SESSION, created_at=BEGUN, ended_at=BEGUN + timedelta(minutes=10))
    write(database, NOW - timedelta(days=1))
    return place


def write(database, at, session_id=None, action="service.start"):
    with database.write() as db:
        audit.append(db, Event(actor=SYSTEM, action=action, session_id=session_id), at)


def ended_session(database, place, session_id, *, created_at, ended_at):
    write(database, created_at, session_id, "session.create")
    add_session(database, session_id, status="ended", ended_at=ended_at)
    (place / "samples" / f"{session_id}.parquet").write_bytes(b"x")


def test_by_a_clock_that_agrees_with_the_records_old_files_go(database, folder):
    assert Machine(database, folder, NOW).removed() == [f"{SESSION}.parquet"]


@pytest.mark.parametrize(
    "off_by", [timedelta(days=3650), timedelta(days=3), timedelta(days=-9000), timedelta(days=-1, minutes=-6)]
)
def test_a_clock_that_starts_far_from_the_records_removes_nothing_for_a_day_of_run_time(database, folder, off_by):
    machine = Machine(database, folder, NOW + off_by)
    assert machine.removed() == []
    assert "nothing is removed for another 24 h of run time" in machine.time.doubt()
    machine.runs(timedelta(hours=23, minutes=59))
    assert machine.removed() == []
    machine.runs(timedelta(minutes=1))
    assert machine.time.doubt() is None
    is_old = machine.now - BEGUN > timedelta(days=30, minutes=10)
    assert machine.removed() == ([f"{SESSION}.parquet"] if is_old else [])


def test_a_clock_that_is_set_while_the_service_runs_is_doubted_from_then_on(database, folder):
    machine = Machine(database, folder, NOW - timedelta(days=1, minutes=-1))
    machine.runs(timedelta(hours=1))
    assert machine.time.doubt() is None
    machine.now += timedelta(days=400)
    assert machine.removed() == []
    assert machine.time.doubt().startswith("the clock was set by +9600.0 h while the service ran")
    machine.runs(timedelta(days=1))
    assert machine.removed() == [f"{SESSION}.parquet"]


def test_small_corrections_of_the_clock_are_no_doubt(database, folder):
    machine = Machine(database, folder, NOW)
    for _ in range(48):
        machine.runs(timedelta(hours=1))
        machine.now += timedelta(minutes=5)
        assert machine.time.doubt() is None


def test_a_session_that_a_wrong_clock_ended_long_ago_is_as_old_as_the_rows_before_it(database, folder):
    """Made at 2001 after a restart; the clock is right again at the next one."""
    in_2001 = BEGUN - timedelta(days=9000)
    ended_session(database, folder, LATER, created_at=in_2001, ended_at=in_2001 + timedelta(minutes=10))
    write(database, NOW)
    machine = Machine(database, folder, NOW + timedelta(hours=1))
    assert machine.removed() == [f"{SESSION}.parquet"]
    machine = Machine(database, folder, NOW + timedelta(days=28))
    machine.runs(timedelta(days=1))
    assert machine.removed() == []
    machine.runs(timedelta(days=2))
    assert machine.removed() == [f"{LATER}.parquet"]


def test_the_clock_is_behind_until_it_has_passed_the_latest_time_not_the_newest_row(database, folder):
    """The start's own rows, written by the wrong clock, do not hide it."""
    in_2001 = BEGUN - timedelta(days=9000)
    machine = Machine(database, folder, in_2001)
    write(database, in_2001)
    write(database, in_2001 + timedelta(minutes=1))
    with database.read() as db:
        assert latest_time(db) == NOW - timedelta(days=1)
        assert machine.time.behind(db, timedelta(seconds=1)) == NOW - timedelta(days=1)
        assert clock_went_back(db, in_2001, 1.0) is not None
        machine.now = NOW
        assert machine.time.behind(db, timedelta(seconds=1)) is None
        assert clock_went_back(db, NOW, 1.0) is None


def test_an_empty_audit_doubts_no_clock(database, tmp_path):
    database.migrate()
    assert Machine(database, tmp_path, NOW).time.doubt() is None
