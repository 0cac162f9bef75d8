"""A journal that one process makes and another writes: its lock goes along, and a start waits for it."""

import os

import pytest

from engine.control.journal.journal import ClientJournal, TransitionJournal
from engine.core.clock import ManualClock
from service.storage.files.journals import read_unless_in_use

pytestmark = pytest.mark.waiting

ID = "0" * 32


@pytest.fixture
def shared(tmp_path):
    """A journal, its owner's part and its client's; its file was handed over as a socket would."""
    journal = TransitionJournal(tmp_path / "one.journal", session_id=ID, clock=ManualClock(), slots=128)
    files = []
    owner = journal.hand_over(lambda file: files.append(os.dup(file)))
    client = ClientJournal(files[0])
    yield journal, owner, client
    client.close()


def test_it_is_in_use_until_the_other_process_is_done_with_it_and_no_longer(shared):
    journal, _, client = shared
    assert read_unless_in_use(journal.path, patience_s=0.0) is None
    client.close()
    assert read_unless_in_use(journal.path, patience_s=0.0) is not None


def test_a_start_waits_a_while_for_an_engine_that_is_on_its_way_out(shared, monkeypatch):
    journal, _, client = shared
    monkeypatch.setattr("service.storage.files.journals.time.sleep", lambda _s: client.close())
    assert read_unless_in_use(journal.path, patience_s=60.0) is not None
