"""The next start gives the audit what a killed process had kept: once, in order, at its own time."""

import contextlib
import itertools
import json
import logging
import os
import signal
import subprocess
import sys
import tempfile
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import select

from engine.control.journal.format import SLOT_BYTES, slot_offset
from engine.control.journal.journal import SLOTS, JournalError
from engine.core.clock import ManualClock
from engine.core.gate_state import GateState, HoldReason
from service.engine_host.equipment import end_engines_holding
from service.sessions.records.audit_events import transition_event
from service.sessions.recovery import journal as journal_recovery
from service.sessions.recovery.journal import JournalInUseError, recover_transitions
from service.storage import audit
from service.storage.database.tables import AuditRow, CalibrationRow, SessionRow
from service.storage.files.journals import Journals
from tests.support.control.transitions import transition
from tests.support.waiting import PATIENCE_S

pytestmark = pytest.mark.slow

NOW = datetime(2026, 11, 21, 20, 0, tzinfo=UTC)
BEGAN_NS = 5_000_000_000
WAY = (GateState.DISARMED, GateState.HOLD, GateState.DWELL, GateState.BEAM_ON, GateState.HOLD)
STEPS = [
    transition(
        BEGAN_NS + index * 1_000_000_000,
        from_state=one,
        to_state=other,
        operator="ann" if index == 0 else None,
        reason=None if other is GateState.BEAM_ON else HoldReason.DWELL,
    )
    for index, (one, other) in enumerate(itertools.pairwise(WAY))
]


def add_session(database, session_id: str = "s1", status: str = "running") -> None:
    with database.write() as db:
        if db.get(CalibrationRow, "c1") is None:
            kept = {"document": "{}", "sha256": "0" * 64, "camera": "x", "uploaded_by": "ann", "created_at": NOW}
            db.add(CalibrationRow(id="c1", **kept))
            db.flush()
        words = dict.fromkeys(("patient_reference", "plan_id", "fraction_id", "source", "window"), "-")
        row = SessionRow(id=session_id, status=status, operator="ann", calibration_id="c1", created_at=NOW, **words)
        row.is_simulated_beam = True
        db.add(row)


@pytest.fixture
def journals(tmp_path):
    return Journals(tmp_path / "data", tmp_path / "journal", memory=tmp_path / "memory")


@pytest.fixture
def left(database, journals):
    """What a process leaves that was killed with a permit foreseen and the last two transitions not committed."""
    add_session(database)
    journal = journals.begin("s1", ManualClock(BEGAN_NS))
    for step in STEPS[:2]:
        number = journal.commit(step)
        with database.write() as db:
            audit.append(db, transition_event("s1", replace(step, number=number)))
    journal.commit(STEPS[2], prepared=journal.prepare(STEPS[2]))
    journal.commit(STEPS[3])
    return killed(journal)


def killed(journal):
    """Let go of the file as the end of a process does."""
    ring, journal._ring = journal._ring, None
    ring.close()
    os.close(journal._file)
    return journal.path


def rows(database, action: str = "gate.transition") -> list[tuple[str, dict]]:
    with database.read() as db:
        found = db.scalars(select(AuditRow).where(AuditRow.action == action).order_by(AuditRow.sequence))
        return [(row.at, json.loads(row.detail)) for row in found]


def path(database) -> list[str]:
    return [detail["to_state"] for _, detail in rows(database)]


@pytest.mark.both_databases
def test_the_audit_gets_what_it_lacks_in_order_and_the_file_goes(database, journals, left):
    recover_transitions(database, journals)
    assert path(database) == ["hold", "dwell", "beam_on", "hold"]
    assert [detail.get("recovered", False) for _, detail in rows(database)] == [False, False, True, True]
    ((_, account),) = rows(database, "journal.recovered")
    assert (account["recovered"], account["kept"], account["last_state"]) == (2, 4, "hold")
    assert account["is_of_this_boot"]
    assert rows(database, "journal.missing") == []
    assert not left.exists()
    with database.read() as db:
        assert audit.verify(db).first_broken_sequence is None


def test_each_is_written_at_its_own_time_by_who_caused_it(database, journals):
    add_session(database)
    journal = journals.begin("s1", ManualClock(BEGAN_NS))
    for step in STEPS:
        journal.commit(step)
    before = datetime.now(UTC)
    killed(journal)
    recover_transitions(database, journals)
    times = [datetime.fromisoformat(at) for at, _ in rows(database)]
    assert [at - times[0] for at in times] == [timedelta(seconds=index) for index in range(4)]
    assert abs(times[0] - before) < timedelta(seconds=10)
    assert [detail["operator"] for _, detail in rows(database)] == ["ann", None, None, None]


def test_a_second_start_finds_nothing_to_do(database, journals, left):
    content = left.read_bytes()
    recover_transitions(database, journals)
    found = rows(database), rows(database, "journal.recovered")
    left.write_bytes(content)  # killed between the commit and the file's end
    recover_transitions(database, journals)
    assert (rows(database), rows(database, "journal.recovered")) == found
    assert not left.exists()


@pytest.mark.both_databases
def test_a_start_that_is_killed_in_the_middle_leaves_all_of_it_to_the_next(database, journals, left, monkeypatch):
    def dies(_kept, _lacking):
        raise KeyboardInterrupt

    with monkeypatch.context() as broken:
        broken.setattr(journal_recovery, "_account", dies)
        with pytest.raises(KeyboardInterrupt):
            recover_transitions(database, journals)
    assert path(database) == ["hold", "dwell"]  # one transaction: nothing of it is there
    assert left.exists()
    recover_transitions(database, journals)
    assert path(database) == ["hold", "dwell", "beam_on", "hold"]


def test_a_permit_that_was_only_foreseen_is_reported_as_one_that_may_not_have_been(database, journals):
    add_session(database)
    journal = journals.begin("s1", ManualClock(BEGAN_NS))
    journal.prepare(STEPS[2])
    killed(journal)
    recover_transitions(database, journals)
    ((_, detail),) = rows(database)
    assert (detail["to_state"], detail["asserted_ns"], detail["decided_ns"]) == ("beam_on", None, STEPS[2].decided_ns)
    assert "not known" in detail["detail"]


def test_a_damaged_slot_is_stated_and_not_believed(database, journals, left):
    content = bytearray(left.read_bytes())
    content[slot_offset(4, SLOTS) + SLOT_BYTES // 2] ^= 255  # the committed permit; the prepared one is in slot 3
    left.write_bytes(content)
    recover_transitions(database, journals)
    assert path(database) == ["hold", "dwell", "beam_on", "hold"]
    assert rows(database)[2][1]["asserted_ns"] is None
    ((_, account),) = rows(database, "journal.recovered")
    assert (account["damaged_slots"], account["missing_numbers"]) == ([3], [4])


def test_a_file_that_is_no_journal_is_kept_aside_and_stated(database, journals, left):
    left.write_bytes(b"something else")
    recover_transitions(database, journals)
    ((_, detail),) = rows(database, "journal.damaged")
    assert (left.parent / detail["kept_as"]).read_bytes() == b"something else"
    assert len(rows(database, "journal.missing")) == 1
    recover_transitions(database, journals)
    assert len(rows(database, "journal.damaged")) == 1


def test_a_journal_of_a_session_that_this_database_does_not_know_is_left_alone(database, journals, caplog):
    path_there = killed(journals.begin("another", ManualClock(BEGAN_NS)))
    with caplog.at_level(logging.WARNING):
        recover_transitions(database, journals)
    assert path_there.exists()
    assert "does not know" in caplog.text
    assert path(database) == []


HOLDS = """
import fcntl, sys, time
file = open(sys.argv[1], "rb")
fcntl.flock(file, fcntl.LOCK_EX)
print("held", flush=True)
time.sleep(600)
"""


def write_module(folder: Path, name: str) -> None:
    """Write a module of this name, run by ``-m``, that holds the file it is given."""
    package = folder.joinpath(*name.split("."))
    package.mkdir(parents=True)
    (package / "__main__.py").write_text(HOLDS)
    while package != folder:
        (package / "__init__.py").touch()
        package = package.parent


@contextlib.contextmanager
def held_by(name: str, path: Path):
    """Hold a journal in a real process of this module name, which is stopped and does not react any more."""
    with tempfile.TemporaryDirectory() as folder:
        write_module(Path(folder), name)
        command = [sys.executable, "-P", "-m", name, str(path)]
        environment = {**os.environ, "PYTHONPATH": folder}
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
            try:
                assert process.stdout.readline() == "held\n"
                process.send_signal(signal.SIGSTOP)
                yield process
            finally:
                process.kill()


@pytest.mark.both_databases
@pytest.mark.parametrize("module", ["service.engine_host.process", "service.engine_process"], ids=["now", "before"])
def test_an_engine_left_behind_is_killed_stated_and_recovered(database, journals, left, monkeypatch, caplog, module):
    """The second name is the module's name in the release before: an upgrade finds its engines too."""
    monkeypatch.setattr("service.storage.files.journals.PATIENCE_S", 0.5)
    with held_by(module, left) as engine:
        recover_transitions(database, journals)
        assert engine.wait(PATIENCE_S) == -signal.SIGKILL
    ((_, said),) = rows(database, "engine.left_behind")
    assert said["processes"] == [engine.pid]
    assert [one.levelname for one in caplog.records if "was killed" in one.getMessage()] == ["CRITICAL"]
    assert path(database) == ["hold", "dwell", "beam_on", "hold"]
    assert rows(database, "journal.missing") == []
    assert not left.exists()


@pytest.mark.both_databases
def test_a_journal_that_stays_in_use_refuses_the_start_and_is_not_called_missing(database, journals, left, monkeypatch):
    monkeypatch.setattr("service.storage.files.journals.PATIENCE_S", 0.0)
    with held_by("somebody.else", left) as other:
        for _ in range(2):
            with pytest.raises(JournalInUseError, match="end it first"):
                recover_transitions(database, journals)
        assert other.poll() is None, "not ours to end"
        assert left.exists()
    ((_, said),) = rows(database, "journal.in_use")
    assert said["journal"] == left.name
    assert rows(database, "journal.missing") == []
    recover_transitions(database, journals)
    assert path(database) == ["hold", "dwell", "beam_on", "hold"]


def test_an_engine_that_holds_another_file_is_let_be(database, journals, left, tmp_path):
    (tmp_path / "another").write_text("")
    with held_by("service.engine_host.process", tmp_path / "another") as engine:
        assert end_engines_holding(left) == []
        assert engine.poll() is None
    recover_transitions(database, journals)
    assert rows(database, "engine.left_behind") == []


def test_another_data_folder_s_journals_are_not_ours(database, journals, tmp_path, left):
    others = Journals(tmp_path / "other data", tmp_path / "journal", memory=tmp_path / "memory")
    assert list(others.left_behind()) == []
    assert list(journals.left_behind()) == [left]


@pytest.mark.both_databases
def test_a_session_that_ran_and_has_no_journal_any_more_is_stated_once(database, journals):
    add_session(database)
    recover_transitions(database, journals)
    recover_transitions(database, journals)
    ((_, detail),) = rows(database, "journal.missing")
    assert "may be lacking" in detail["detail"]


def test_a_journal_in_the_folder_of_an_earlier_setting_is_found_too(database, tmp_path):
    add_session(database)
    (tmp_path / "memory").mkdir()
    before = Journals(tmp_path / "data", None, memory=tmp_path / "memory")
    journal = before.begin("s1", ManualClock(BEGAN_NS))
    assert journal.path.parent == tmp_path / "memory"
    journal.commit(STEPS[0])
    killed(journal)
    recover_transitions(database, Journals(tmp_path / "data", tmp_path / "elsewhere", memory=tmp_path / "memory"))
    assert path(database) == ["hold"]


def test_without_memory_to_use_it_lies_in_the_data_folder(tmp_path):
    journals = Journals(tmp_path / "data", None, memory=tmp_path / "no such folder")
    journal = journals.begin("s1")
    assert journal.path.parent == tmp_path / "data" / "journal"
    journal.close()


def test_memory_without_room_is_no_reason_not_to_begin(tmp_path, monkeypatch):
    (tmp_path / "memory").mkdir()
    allocate = os.posix_fallocate

    def has_room_on_disk(file, offset, size):
        if Path(f"/proc/self/fd/{file}").readlink().is_relative_to(tmp_path / "memory"):
            raise OSError(28, "No space left on device")
        allocate(file, offset, size)

    monkeypatch.setattr("engine.control.journal.journal.os.posix_fallocate", has_room_on_disk)
    journal = Journals(tmp_path / "data", None, memory=tmp_path / "memory").begin("s1")
    assert journal.path.parent == tmp_path / "data" / "journal"
    assert list((tmp_path / "memory").iterdir()) == []
    journal.close()


def test_a_folder_that_cannot_be_made_is_stated(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(JournalError, match="kept safe"):
        Journals(tmp_path / "data", tmp_path / "file" / "in it").begin("s1")


def test_a_journal_whose_session_does_not_begin_leaves_no_file(journals):
    with pytest.raises(LookupError), journals.begun("s1") as journal:
        raise LookupError
    assert not journal.path.exists()
