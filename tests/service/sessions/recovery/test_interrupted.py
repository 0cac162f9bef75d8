"""Recovery of a killed process's session at the next start: recorded once, even if that start is killed too."""

import json
import os
import signal

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from sqlalchemy import select

from engine.core.gate_state import GateState
from service.sessions.recovery import interrupted
from service.sessions.recovery.interrupted import close_interrupted
from service.storage import audit
from service.storage.audit import AuditRow
from service.storage.database.engine import Database
from service.storage.database.tables import SessionRow
from service.storage.samples import parquet, store as shelves
from service.storage.samples.check import check, registered
from tests.support.samples.records import HEAD, PERIOD_NS, SESSION, frames_of, record, write_stream
from tests.support.samples.sessions import BEGUN, add_session

pytestmark = pytest.mark.slow


def reported(database, *actions):
    with database.read() as db:
        query = select(AuditRow).where(AuditRow.action.in_(actions)).order_by(AuditRow.sequence)
        return [(row.action, row.outcome, json.loads(row.detail)) for row in db.scalars(query)]


def session_of(database):
    with database.read() as db:
        return db.get(SessionRow, SESSION)


@pytest.mark.both_databases
def test_an_interrupted_session_gets_its_parquet_and_its_figures(database, sample_store):
    add_session(database)
    write_stream(sample_store.folder, is_finished=False)
    close_interrupted(database, sample_store)
    row = session_of(database)
    summary = json.loads(row.summary)
    assert (row.status, summary["frames"], summary["lost"]) == ("interrupted", 40, 8)
    assert summary["latency"]["max_ms"] == pytest.approx(6.039)
    assert summary["beam_on_s"] == 0.0
    ((_, outcome, detail),) = reported(database, "session.close")
    assert (outcome, detail["samples"]["rows"], detail["samples"]["ending"]) == ("failed", 40, "open")
    assert detail["samples"]["parquet_sha256"] == parquet.file_sha256(sample_store.parquet_path(SESSION))
    assert reported(database, "samples.repaired") == []
    assert (sample_store.left_streams(), frames_of(sample_store)) == ([], list(range(40)))


@pytest.mark.both_databases
def test_the_delivered_time_and_the_holds_of_an_interrupted_session_are_kept(database, sample_store):
    add_session(database)
    stream = sample_store.begin(HEAD)
    stream.append([record(index, gate=GateState.BEAM_ON) for index in range(20)])
    stream.sync()
    stream.release()
    with database.write() as db:
        for reason in ("marker_lost", "outside_window", "outside_window"):
            detail = {"from_state": "beam_on", "to_state": "hold", "reason": reason}
            audit.append(db, audit.Event(actor="tidegate", action="gate.transition", session_id=SESSION, detail=detail))
    close_interrupted(database, sample_store)
    summary = json.loads(session_of(database).summary)
    assert summary["beam_on_s"] == pytest.approx(19 * PERIOD_NS / 1e9, abs=0.001)
    assert [(one["reason"], one["count"]) for one in summary["holds"]] == [("outside_window", 2), ("marker_lost", 1)]


def test_a_torn_tail_is_stated_in_the_audit_with_rows_and_bytes(database, sample_store):
    add_session(database)
    path = write_stream(sample_store.folder, is_finished=False).path
    path.write_bytes(path.read_bytes()[:-500])
    close_interrupted(database, sample_store)
    ((_, outcome, detail),) = reported(database, "samples.repaired")
    assert (outcome, detail["rows"], detail["ending"]) == ("done", 32, "torn")
    assert detail["lost_bytes"] > 1000
    assert frames_of(sample_store) == list(range(32))


def test_a_damaged_file_is_kept_aside_and_stated_as_a_failure(database, sample_store, caplog):
    add_session(database)
    path = write_stream(sample_store.folder).path
    path.write_bytes(path.read_bytes().replace(b"5" * 64, b"6" * 64, 1))
    close_interrupted(database, sample_store)
    ((_, outcome, detail),) = reported(database, "samples.repaired")
    assert (outcome, detail["rows"], detail["kept_aside"]) == ("failed", 0, f"{SESSION}.damaged.arrows")
    assert (sample_store.folder / detail["kept_aside"]).exists()
    assert "kept in" in caplog.text
    assert "P-0001" not in caplog.text


def test_a_start_with_nothing_left_states_nothing(database, sample_store):
    add_session(database, status="ended", ended_at=BEGUN)
    write_stream(sample_store.folder)
    sample_store.settle(SESSION)
    sample_store.forget_stream(SESSION)
    close_interrupted(database, sample_store)
    assert reported(database, "session.close", "samples.settled", "samples.repaired") == []


def test_a_session_that_was_killed_before_its_file_was_there_is_closed_too(database, sample_store):
    add_session(database)
    close_interrupted(database, sample_store)
    assert session_of(database).status == "interrupted"
    assert json.loads(session_of(database).summary)["frames"] == 0


def test_a_full_disk_keeps_the_stream_and_the_next_start_settles_it(database, sample_store, monkeypatch):
    add_session(database)
    write_stream(sample_store.folder, is_finished=False)

    def full(_path, _schema, batches):
        next(batches)
        raise OSError(28, "full")

    with monkeypatch.context() as patch:
        patch.setattr(shelves, "write_parquet", full)
        close_interrupted(database, sample_store)
    assert (session_of(database).status, sample_store.left_streams()) == ("interrupted", [SESSION])
    assert json.loads(session_of(database).summary)["frames"] == 40
    assert frames_of(sample_store) == list(range(40))
    close_interrupted(database, sample_store)
    ((_, _, detail),) = reported(database, "samples.settled")
    assert (detail["rows"], sample_store.left_streams()) == (40, [])
    with database.read() as db:
        assert registered(db, SESSION).sha256 == detail["parquet_sha256"]


def refuse(*_arguments, **_options):
    raise PermissionError(1, "Operation not permitted")


def spoil_head(path):
    path.write_bytes(b"\x00" * 100)


def test_a_damaged_file_is_kept_aside_as_a_copy_where_a_file_can_have_but_one_name(database, sample_store, monkeypatch):
    add_session(database)
    path = write_stream(sample_store.folder, is_finished=False).path
    spoil_head(path)
    monkeypatch.setattr(os, "link", refuse)
    close_interrupted(database, sample_store)
    ((_, outcome, detail),) = reported(database, "samples.repaired")
    assert (outcome, detail["lost_bytes"]) == ("failed", 100)
    assert (sample_store.folder / detail["kept_aside"]).read_bytes() == b"\x00" * 100
    assert session_of(database).status == "interrupted"
    assert [path.name for path in sample_store.folder.iterdir()] == [detail["kept_aside"]]


def test_a_stream_that_can_be_neither_read_nor_kept_aside_lets_the_session_be_closed(
    database, sample_store, monkeypatch
):
    add_session(database)
    spoil_head(write_stream(sample_store.folder, is_finished=False).path)
    monkeypatch.setattr(os, "link", refuse)
    monkeypatch.setattr(shelves.shutil, "copyfile", refuse)
    close_interrupted(database, sample_store)
    ((_, _, detail),) = reported(database, "session.close")
    assert "cannot be read (NoSamplesError)" in detail["samples"]["detail"]
    assert (session_of(database).status, sample_store.left_streams()) == ("interrupted", [SESSION])


@pytest.mark.parametrize("spoiled", ["its end", "a page", "its schema"])
def test_a_session_of_which_only_a_damaged_parquet_is_left_is_closed_and_the_audit_states_why(
    database, sample_store, spoiled
):
    add_session(database)
    write_stream(sample_store.folder)
    sample_store.settle(SESSION)
    sample_store.forget_stream(SESSION)
    path = sample_store.parquet_path(SESSION)
    content = path.read_bytes()
    if spoiled == "its schema":
        pq.write_table(pa.table({"another": [1]}), path)
    else:
        path.write_bytes(content[:-8] + bytes(8) if spoiled == "its end" else bytes(2000) + content[2000:])
    before = path.read_bytes()
    close_interrupted(database, sample_store)
    ((_, outcome, detail),) = reported(database, "session.close")
    assert outcome == "failed"
    assert "the sample file cannot be read" in detail["samples"]["detail"]
    assert detail["summary"]["frames"] == json.loads(session_of(database).summary)["frames"] == 0
    assert path.read_bytes() == before


STEPS = {
    "before the parquet is written": (shelves, "write_parquet", True),
    "before it is read back": (parquet, "_group_digests", True),
    "before it has its name": (parquet, "put_in_place", True),
    "after it has its name": (parquet, "put_in_place", False),
    "before the end is written down": (interrupted, "closing_event", True),
    "in the middle of that": (audit, "append", False),
    "before the stream goes": (shelves, "remove", True),
    "after the stream went": (shelves, "remove", False),
}


@pytest.mark.parametrize("step", STEPS)
def test_a_start_that_is_killed_at_any_step_leaves_it_to_the_next(database, sample_store, step):
    """A process killed twice between two system calls; afterwards the audit has each fact once."""
    add_session(database)
    write_stream(sample_store.folder, is_finished=False)
    assert _killed_at(database.path, sample_store, STEPS[step]) == signal.SIGKILL
    _killed_at(database.path, sample_store, STEPS[step])
    close_interrupted(database, sample_store)
    ((_, _, detail),) = reported(database, "session.close")
    assert detail["samples"]["rows"] == 40
    assert session_of(database).status == "interrupted"
    assert [path.name for path in sample_store.folder.iterdir()] == [f"{SESSION}.parquet"]
    assert frames_of(sample_store) == list(range(40))
    with database.read() as db:
        assert check(sample_store, SESSION, registered(db, SESSION), is_open=False).is_good
        assert audit.verify(db).first_broken_sequence is None


def _killed_at(path, sample_store, step):
    module, name, is_before = step
    child = os.fork()
    if child == 0:
        real = getattr(module, name)

        def die(*arguments, **options):
            if not is_before:
                real(*arguments, **options)
            os.kill(os.getpid(), signal.SIGKILL)

        setattr(module, name, die)
        try:
            close_interrupted(Database(path), sample_store)
        finally:
            os._exit(1)
    return os.WTERMSIG(os.waitpid(child, 0)[1])
