"""A session's journal: there before the session runs, confirmed by what is committed, gone when all of it is."""

import logging
import os
from dataclasses import replace
from pathlib import Path

import pytest

from engine.core.errors import SourceLostError
from engine.core.gate_state import GateState
from service.storage.files.journals import Journals
from tests.support.service.api_calls import act, audit_rows
from tests.support.waiting import eventually


@pytest.fixture
def settings(settings):
    return settings.model_copy(update={"journal_dir": settings.data_dir / "kept"})


@pytest.fixture
def journals(settings):
    """The service's, in a folder of the test's."""
    return Journals(settings.data_dir, settings.journal_dir)


def test_a_session_has_a_journal_while_it_runs_and_none_once_it_is_closed(client, journals, session_id, engine):
    assert act(client, session_id, "start").status_code == 200
    (path,) = journals.left_behind()
    assert session_id in path.name
    assert act(client, session_id, "stop").status_code == 200
    assert list(journals.left_behind()) == []


def test_what_is_committed_is_confirmed_and_what_is_not_keeps_its_file(client, journals, session_id, engine):
    act(client, session_id, "start")
    journal = engine.running.plan.journal
    lost = engine.running.transition(GateState.HOLD)
    journal.commit(lost)
    assert not journal.is_acknowledged
    kept = replace(lost, from_state=GateState.HOLD, to_state=GateState.DWELL)
    engine.running.transitions.put_nowait(replace(kept, number=journal.commit(kept)))
    eventually(lambda: journal.is_acknowledged)
    journal.commit(lost)  # never acknowledged by the writer
    act(client, session_id, "stop")
    assert list(journals.left_behind()) == [journal.path]


def test_a_session_whose_transitions_cannot_be_kept_does_not_begin(client, journals, session_id, engine, settings):
    (settings.data_dir / "kept").write_text("no folder")
    answer = act(client, session_id, "start")
    assert (answer.status_code, answer.json()["code"]) == (503, "journal_unavailable")
    assert engine.opened == []
    assert client.get(f"/api/v1/sessions/{session_id}").json()["status"] == "created"
    assert audit_rows(client, "session.start")[-1]["outcome"] == "refused"


def test_a_session_whose_source_does_not_open_leaves_no_journal(client, journals, session_id, engine):
    engine.fail_with = SourceLostError("gone")
    assert act(client, session_id, "start").status_code == 503
    assert list(journals.left_behind()) == []


def test_a_journal_that_lies_on_a_disk_for_want_of_memory_is_stated_with_the_reason(tmp_path, caplog):
    with caplog.at_level(logging.WARNING, "service.storage.files.journals"):
        journal = Journals(tmp_path / "data", None, memory=tmp_path / "no such folder").begin("s1")
    journal.close()
    (record,) = caplog.records
    assert f"{tmp_path / 'data' / 'journal'}" in record.message
    assert f"{tmp_path / 'no such folder'} cannot be written to" in record.message


def test_a_journal_that_lies_on_a_disk_because_memory_is_full_is_stated_with_the_reason(tmp_path, caplog, monkeypatch):
    memory = tmp_path / "memory"
    memory.mkdir()
    allocate = os.posix_fallocate

    def has_room_on_disk(file, offset, size):
        if Path(f"/proc/self/fd/{file}").readlink().is_relative_to(memory):
            raise OSError(28, "No space left on device")
        allocate(file, offset, size)

    monkeypatch.setattr("engine.control.journal.journal.os.posix_fallocate", has_room_on_disk)
    with caplog.at_level(logging.WARNING, "service.storage.files.journals"):
        journal = Journals(tmp_path / "data", None, memory=memory).begin("s1")
    journal.close()
    (record,) = caplog.records
    assert "No space left on device" in record.message


@pytest.mark.parametrize("reported", [None, "folder"])
def test_a_journal_in_memory_or_in_the_set_folder_gives_no_warning(tmp_path, caplog, reported):
    (tmp_path / "memory").mkdir()
    journals = Journals(tmp_path / "data", reported and tmp_path / reported, memory=tmp_path / "memory")
    with caplog.at_level(logging.WARNING, "service.storage.files.journals"):
        journals.begin("s1").close()
    assert caplog.records == []


def test_the_start_of_the_service_reports_where_journals_are_made(client, settings):
    (row,) = audit_rows(client, "service.start")
    assert row["detail"]["journal_folder"] == str(Journals(settings.data_dir, settings.journal_dir).folder)
