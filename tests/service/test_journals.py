"""A session's journal: there before the session runs, confirmed by what is committed, gone when all of it is."""

from dataclasses import replace

import pytest

from engine.errors import SourceLostError
from engine.permits import GateState
from service.journals import Journals
from tests.service.conftest import act, audit_rows, eventually


@pytest.fixture
def journals(settings, client, monkeypatch):
    """The service's, in a folder of the test's."""
    made = Journals(settings.data_dir, settings.data_dir / "kept")
    monkeypatch.setattr(client.app.state.services.runner, "_journals", made)
    return made


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
    journal.write(lost)
    assert not journal.is_confirmed
    kept = replace(lost, from_state=GateState.HOLD, to_state=GateState.DWELL)
    engine.running.transitions.put_nowait(replace(kept, number=journal.write(kept)))
    eventually(lambda: journal.is_confirmed)
    journal.write(lost)  # of which the writer never hears
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
