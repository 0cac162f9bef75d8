"""What takes permission away waits behind no read: neither for a thread, nor for a connection, nor for a lock."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import anyio.to_thread
import pytest
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from engine.core.commands import Disarm, HoldBeam
from service.qa import queries as records
from service.storage.audit.log import AuditLog
from service.storage.database import queries
from service.storage.database.tables import SessionRow
from tests.support.service.api_calls import act, audit_rows
from tests.support.service.busy_threads import (
    CONNECTIONS,
    LONGEST_S,
    THREADS,
    Jam,
    ask_for_lists,
    reads,
    waiting_for_a_thread,
)
from tests.support.waiting import eventually

pytestmark = pytest.mark.slow

JSON = {"Content-Type": "application/json"}
AWAY = ["hold", "disarm", "stop"]


@pytest.fixture
def no_thread_is_left(client, running):
    """Every thread of the event loop is in a read that does not end, and others wait behind them."""
    with reads(client, THREADS + 5) as (jam, pool):
        state = client.app.state
        usual = state.services
        state.services = replace(usual, sessions=jam)
        ask_for_lists(client, pool, THREADS + 5)
        eventually(lambda: jam.inside == THREADS and waiting_for_a_thread(client) == 5, within_s=LONGEST_S)
        yield pool
        assert jam.inside == THREADS, "they were blocked all the time"
        state.services = usual


@pytest.fixture
def no_connection_is_left(client, running, monkeypatch):
    """Every connection of the pool is in a read that does not end."""
    with reads(client, CONNECTIONS) as (jam, pool):
        monkeypatch.setattr(queries, "session_page", jam.rows)
        ask_for_lists(client, pool, CONNECTIONS)
        eventually(lambda: jam.inside == CONNECTIONS, within_s=LONGEST_S)
        yield pool
        assert jam.inside == CONNECTIONS, "they were blocked all the time"


def was_reported(running, action: str) -> bool:
    if action == "stop":
        return running.status.is_over
    return [type(command) for command in running.commands] == [{"hold": HoldBeam, "disarm": Disarm}[action]]


@pytest.mark.parametrize("action", AWAY)
@pytest.mark.usefixtures("no_thread_is_left")
def test_it_is_answered_while_reads_have_every_thread(client, session_id, running, no_thread_is_left, action):
    answer = no_thread_is_left.submit(act, client, session_id, action).result(LONGEST_S)
    assert answer.status_code == 200, answer.text
    assert was_reported(running, action)


@pytest.mark.parametrize("action", AWAY)
def test_it_is_answered_while_reads_have_every_connection(client, session_id, running, no_connection_is_left, action):
    answer = no_connection_is_left.submit(act, client, session_id, action).result(LONGEST_S)
    assert answer.status_code == 200, answer.text
    assert was_reported(running, action)


@pytest.mark.parametrize("action", ["hold", "disarm"])
def test_its_refusal_too_is_answered_while_reads_have_every_thread(
    client, session_id, running, no_thread_is_left, action
):
    running.is_silent = True
    answer = no_thread_is_left.submit(act, client, session_id, action).result(LONGEST_S)
    assert (answer.status_code, answer.json()["code"]) == (503, "engine_timeout")
    assert was_reported(running, action)


@pytest.mark.parametrize("action", ["presence", "arm", "start"])
def test_nothing_else_takes_a_connection_that_is_theirs(client, session_id, running, monkeypatch, action):
    act(client, session_id, "stop")
    monkeypatch.setattr(client.app.state.services.runner._priority_database, "read", None)
    assert act(client, session_id, action).json()["code"] == "session_state"


@pytest.mark.parametrize("action", ["hold", "disarm"])
def test_an_executed_call_without_its_audit_row_is_not_reported_as_unchanged(
    client, session_id, running, monkeypatch, action
):
    def gone(*_arguments: object) -> None:
        raise OperationalError("", None, Exception())

    with monkeypatch.context() as patch:
        patch.setattr(AuditLog, "write", gone)
        answer = act(client, session_id, action)
    assert (answer.status_code, answer.json()["code"]) == (503, "storage_unavailable")
    assert "may have been carried out" in answer.json()["detail"]
    assert was_reported(running, action)


def test_a_stop_waits_for_no_start_once_its_session_runs(client, session_id, running):
    starting = client.app.state.services.runner._session_lock
    with ThreadPoolExecutor(1) as pool, starting:
        assert pool.submit(act, client, session_id, "stop").result(LONGEST_S).status_code == 200


def in_a_thread_of_all(client) -> int:
    async def look() -> int:
        return anyio.to_thread.current_default_thread_limiter().statistics().borrowed_tokens

    return client.portal.call(look)


@contextmanager
def nothing_to_take(client, jam: Jam, path: str) -> Iterator[ThreadPoolExecutor]:
    """Let more such calls than there are own threads, or own connections, wait for what has nothing to take away."""
    client.headers_as("A. Therapist")
    with ThreadPoolExecutor(CONNECTIONS + 2) as pool, client.app.state.services.runner._session_lock:
        try:
            asked = [pool.submit(client.post, path.format(f"{n:032x}"), json={}) for n in range(CONNECTIONS + 1)]
            eventually(lambda: in_a_thread_of_all(client) == CONNECTIONS + 1)
            yield pool
            assert not any(one.done() for one in asked), "they were blocked all the time"
        finally:
            jam.end()


@pytest.mark.parametrize(("action", "idle"), [("hold", "stop"), ("disarm", "hold"), ("stop", "disarm")])
def test_it_is_answered_while_such_calls_for_sessions_that_do_not_run_wait(
    client, session_id, running, monkeypatch, action, idle
):
    jam, found = Jam(), queries.session_row

    def row(db: Session, wanted: str) -> SessionRow:
        return found(db, wanted) if wanted == session_id else jam.then(found)(db, wanted)

    monkeypatch.setattr(queries, "session_row", row)
    with nothing_to_take(client, jam, f"/api/v1/sessions/{{}}/{idle}") as pool:
        answer = pool.submit(act, client, session_id, action).result(LONGEST_S)
        assert answer.status_code == 200, answer.text
        assert was_reported(running, action)


def test_it_is_answered_while_cancellings_of_qa_runs_that_are_over_wait(client, session_id, running, monkeypatch):
    jam = Jam()
    monkeypatch.setattr(records, "run_row", jam.then(records.run_row))
    with nothing_to_take(client, jam, "/api/v1/qa/runs/{}/cancel") as pool:
        assert pool.submit(act, client, session_id, "hold").result(LONGEST_S).status_code == 200
        assert was_reported(running, "hold")


@pytest.mark.parametrize("action", AWAY)
def test_for_whom_a_machine_acts_is_known_in_its_thread_too(client, session_id, running, action):
    key = client.desk.keys.create("tps", ["gate.hold"], datetime.now(UTC) + timedelta(days=1), by="test")
    client.speaks_as = None
    url, headers = f"/api/v1/sessions/{session_id}/{action}", {"Authorization": f"Bearer {key.secret}"}
    assert client.post(url, content=b'{"operator": "C. Nurse"}', headers=headers | JSON).status_code == 200
    client.speaks_as = "A. Therapist"
    row = audit_rows(client, f"session.{action}")[-1]
    assert (row["actor"], row["detail"]["on_behalf_of"]) == ("key:tps", "C. Nurse")
