"""The database's server is restarted, killed or stands still under a running session: the gate learns of it in time.

On a real server of these tests' own. What is written in the meantime waits, and is there once the server is.
"""

import contextlib
import os
import socket
import threading
import time

import pytest
from sqlalchemy import text
from sqlalchemy.exc import SQLAlchemyError

from engine.core.commands import HoldBeam
from engine.core.gate_state import GateState, HoldReason
from service.sessions.lifecycle import writer
from service.storage import audit
from service.storage.database.engine import ANSWER_TIMEOUT_S, Database, DatabaseInUseError
from tests.support.service.api_calls import act, audit_rows
from tests.support.waiting import eventually

pytestmark = pytest.mark.slow

BEHIND = HoldReason.AUDIT_BEHIND
ADVISORY = (
    "FROM pg_locks WHERE locktype = 'advisory' AND database = "
    "(SELECT oid FROM pg_database WHERE datname = current_database())"
)
IN_TIME_S = ANSWER_TIMEOUT_S
"""Sooner than a call that waits for the server; how soon the gate itself holds is rule 7's."""


@pytest.fixture
def place(own_postgres_server):
    url = own_postgres_server.migrated()
    yield url
    own_postgres_server.drop(url)


@pytest.fixture
def server(own_postgres_server):
    return own_postgres_server


@pytest.fixture
def quick_looks(monkeypatch):
    monkeypatch.setattr(writer, "DISK_CHECK_S", 0.05)


def expect_hold(running):
    running.faults.clear()
    eventually(lambda: BEHIND in running.faults, within_s=IN_TIME_S)


def is_whole(place):
    database = Database(place)
    with database.read() as db:
        found = audit.verify(db)
    database.close()
    return found.is_intact


@pytest.mark.parametrize("end", ["stop", "kill"])
def test_a_server_that_goes_is_reported_while_it_is_away_and_nothing_is_lost(
    client, session_id, running, server, place, quick_looks, end
):
    running.transition(GateState.HOLD, HoldReason.DWELL)
    eventually(lambda: len(audit_rows(client, "gate.transition")) == 1)
    getattr(server, end)()
    expect_hold(running)
    running.transition(GateState.DWELL, None)
    running.frame()
    expect_hold(running)
    assert act(client, session_id, "arm").status_code == 503
    eventually(lambda: client.get("/readyz").status_code == 503)
    server.start()
    eventually(lambda: len(audit_rows(client, "gate.transition")) == 2, within_s=10.0)
    running.faults.clear()
    running.transition(GateState.HOLD, HoldReason.DWELL)
    eventually(lambda: len(audit_rows(client, "gate.transition")) == 3)
    assert running.faults == []
    eventually(lambda: client.get("/readyz").status_code == 200)
    assert is_whole(place)


def test_a_server_that_stands_still_is_reported_and_prevents_no_hold(client, session_id, running, server, quick_looks):
    server.pause()
    try:
        running.transition(GateState.HOLD, HoldReason.DWELL)
        expect_hold(running)
        asked = threading.Thread(target=act, args=(client, session_id, "hold"))
        asked.start()
        eventually(lambda: any(isinstance(command, HoldBeam) for command in running.commands), within_s=IN_TIME_S)
    finally:
        server.go_on()
    asked.join(15.0)
    assert not asked.is_alive()
    eventually(lambda: len(audit_rows(client, "gate.transition")) >= 1, within_s=10.0)


def test_an_answer_that_does_not_come_ends_the_wait_and_the_connection(server, place):
    database = Database(place, answer_timeout_s=0.3)
    with database.read() as db:
        assert db.scalar(text("SELECT 1")) == 1
    server.pause()
    try:
        began_s = time.monotonic()
        with pytest.raises(SQLAlchemyError), database.read() as db:
            db.scalar(text("SELECT 2"))
        assert time.monotonic() - began_s < IN_TIME_S
    finally:
        server.go_on()
    with database.read() as db:
        assert db.scalar(text("SELECT 3")) == 3
    database.close()


def test_a_statement_that_takes_too_long_is_ended_by_the_server_itself(place):
    others = "SELECT count(*) FROM pg_stat_activity WHERE query LIKE '%pg_sleep(30)%' AND pid <> pg_backend_pid()"
    with contextlib.closing(Database(place, answer_timeout_s=0.3)) as database:
        with pytest.raises(SQLAlchemyError), database.read() as db:
            db.scalar(text("SELECT pg_sleep(30)"))

        def is_busy():
            with database.read() as db:
                return db.scalar(text(f"{others} AND state = 'active'")) > 0

        eventually(lambda: not is_busy(), within_s=10.0)


def test_one_writes_at_a_time_and_a_long_wait_is_refused(place):
    one, other = Database(place), Database(place, busy_timeout_s=0.2)
    with one.write(), pytest.raises(SQLAlchemyError, match="lock timeout"), other.write():
        pass
    with other.write() as db:
        db.execute(text("SELECT 1"))
    one.close()
    other.close()


def test_who_waited_for_the_lock_sees_what_the_one_before_wrote_whatever_the_server_s_default(place):
    options = {"options": r"-c default_transaction_isolation=repeatable\ read"}
    one, other = Database(place), Database(place.update_query_dict(options))
    waiting = threading.Thread(target=_append, args=(other,))
    with one.write() as db:
        waiting.start()
        eventually(lambda: _waiters(one) == 1)
        audit.append(db, audit.Event(actor="me", action="first"))
    waiting.join(10.0)
    with one.read() as db:
        last = db.scalars(text("SELECT action FROM audit ORDER BY sequence DESC LIMIT 2")).all()
    assert last == ["second", "first"]
    assert is_whole(place)
    one.close()
    other.close()


def _append(database):
    with contextlib.suppress(SQLAlchemyError), database.write() as db:
        audit.append(db, audit.Event(actor="me", action="second"))


def _waiters(database):
    return _count(database, f"{ADVISORY} AND NOT granted")


def test_another_database_in_its_place_is_not_the_one_that_was_opened(server, place):
    database = Database(place)
    assert database.trouble() is None
    with database.write() as db:
        db.execute(text("ALTER TABLE audit RENAME TO audit_aside"))
        db.execute(text("CREATE TABLE audit (LIKE audit_aside INCLUDING ALL)"))
    assert "another database" in database.trouble()
    with database.write() as db:
        db.execute(text("DROP TABLE audit"))
        db.execute(text("ALTER TABLE audit_aside RENAME TO audit"))
    assert database.trouble() is None
    database.close()


def test_what_the_site_s_url_states_of_commits_does_not_make_them_less_durable(place):
    database = Database(place.update_query_dict({"options": "-c synchronous_commit=off"}))
    with database.read() as db:
        assert db.scalar(text("SHOW synchronous_commit")) == "on"
    database.close()


def test_who_reads_sees_one_moment_and_changes_nothing(place):
    database = Database(place)
    with database.read() as db:
        before = db.scalar(text("SELECT count(*) FROM audit"))
        with database.write() as other:
            audit.append(other, audit.Event(actor="me", action="meanwhile"))
        assert db.scalar(text("SELECT count(*) FROM audit")) == before
        with pytest.raises(SQLAlchemyError, match="read-only"):
            db.execute(text("DELETE FROM idempotency_keys"))
    database.close()


def test_a_database_has_one_service_at_a_time(place):
    one, other = Database(place), Database(place)
    one.claim()
    with pytest.raises(DatabaseInUseError, match="another Tidegate service"):
        other.claim()
    with other.write() as db:  # a backup beside it is none
        db.execute(text("SELECT 1"))
    one.close()
    other.claim()
    other.close()


def test_a_lock_whose_connection_ended_is_taken_again_at_the_next_look(place):
    one, other = Database(place), Database(place)
    one.claim()
    writers = one.twin(busy_timeout_s=0.5, answer_timeout_s=1.0)
    _end_who_has_it(other)
    assert writers.trouble() is None
    with pytest.raises(DatabaseInUseError):
        other.claim()
    _close(writers, one, other)


def test_a_lock_that_another_service_took_meanwhile_is_reported_for_as_long_as_it_has_it(place):
    one, other = Database(place), Database(place)
    one.claim()
    writers = one.twin(busy_timeout_s=0.5, answer_timeout_s=1.0)
    _end_who_has_it(other)
    other.claim()
    assert "lost its lock" in writers.trouble()
    assert "lost its lock" in one.trouble()
    other.close()
    assert writers.trouble() is None
    _close(writers, one)


def test_a_connection_that_only_the_server_still_knows_does_not_keep_the_lock_from_us(place):
    one, other = Database(place), Database(place)
    one.claim()
    number = one._claim._connection.connection.dbapi_connection.fileno()
    way = os.dup(number)  # stays open: the server gets no end of the connection
    broken, end = socket.socketpair()
    end.close()
    os.dup2(broken.fileno(), number)
    broken.close()
    eventually(lambda: one.trouble() is None)
    with pytest.raises(DatabaseInUseError):
        other.claim()
    os.close(way)
    _close(one, other)


def test_a_standby_that_takes_over_is_not_the_server_that_was_written_to(server, place):
    database = Database(place)
    assert database.trouble() is None
    server.stop()
    server.start_as_standby()
    assert "standby" in _trouble_now(database)
    server.promote()
    assert "another database" in database.trouble()
    database.close()


def _trouble_now(database):
    """Look once more than a connection that the restart has ended."""
    with contextlib.suppress(SQLAlchemyError):
        return database.trouble()
    return database.trouble()


def _end_who_has_it(database):
    """End the connection behind the service's lock, and wait until the server has let the lock go."""
    with database.read() as db:
        db.execute(text(f"SELECT pg_terminate_backend(pid) {ADVISORY}"))
    eventually(lambda: _count(database, ADVISORY) == 0)


def _count(database, what):
    with database.read() as db:
        return db.scalar(text(f"SELECT count(*) {what}"))


def _close(*databases):
    for database in databases:
        database.close()
