"""A journal that one process makes and another writes: the lock goes along; what is acknowledged is removed."""

import os

import pytest

from engine.control.journal.format import read_journal
from engine.control.journal.journal import ClientJournal, JournalError, TransitionJournal
from engine.control.outputs import GateTransition
from engine.core.clock import ManualClock
from engine.core.gate_state import GateState
from service.storage.files.journals import read_unless_in_use

ID = "0" * 32


def _transition(at_ns: int) -> GateTransition:
    return GateTransition(
        at_ns=at_ns,
        frame_index=1,
        from_state=GateState.HOLD,
        to_state=GateState.DWELL,
        reason=None,
        operator=None,
        detail="",
        captured_us=1,
        received_ns=1,
        decided_ns=at_ns,
        asserted_ns=at_ns,
    )


@pytest.fixture
def shared(tmp_path):
    """A journal, the part of it that owner, and the part that went; its file was handed over as a socket would."""
    journal = TransitionJournal(tmp_path / "one.journal", session_id=ID, clock=ManualClock(), slots=128)
    files = []
    owner = journal.hand_over(lambda file: files.append(os.dup(file)))
    client = ClientJournal(files[0])
    yield journal, owner, client
    client.close()


def test_what_the_other_process_writes_is_in_the_file_that_this_one_made(shared):
    journal, _, client = shared
    assert [client.commit(_transition(at_ns)) for at_ns in (5, 6)] == [1, 2]
    kept = read_journal(journal.path.read_bytes())
    assert [entry.transition.at_ns for entry in kept.entries] == [5, 6]
    assert (kept.header.session_id, kept.damaged_slots, kept.missing_numbers) == (ID, (), ())


def test_it_is_in_use_until_the_other_process_is_done_with_it_and_no_longer(shared):
    journal, _, client = shared
    assert read_unless_in_use(journal.path, patience_s=0.0) is None
    client.close()
    assert read_unless_in_use(journal.path, patience_s=0.0) is not None


def test_a_start_waits_a_while_for_an_engine_that_is_on_its_way_out(shared, monkeypatch):
    journal, _, client = shared
    monkeypatch.setattr("service.storage.files.journals.time.sleep", lambda _s: client.close())
    assert read_unless_in_use(journal.path, patience_s=60.0) is not None


@pytest.mark.parametrize("acknowledged", [0, 1, 2])
def test_the_file_is_removed_once_all_entries_are_acknowledged(shared, acknowledged):
    journal, owner, client = shared
    client.commit(_transition(5))
    client.commit(_transition(6))
    journal.acknowledge(acknowledged)
    assert owner.acknowledged == acknowledged
    owner.client_closed(client.newest_committed)
    assert not journal.is_orphaned
    journal.close()
    assert journal.path.exists() is (acknowledged < 2)


def test_a_writer_that_never_said_how_far_it_came_leaves_the_file_to_be_read(shared):
    journal, _, client = shared
    client.commit(_transition(5))
    journal.acknowledge(1)
    assert journal.is_orphaned
    journal.close()
    assert journal.path.exists(), "it may have written more than was heard"


def test_one_that_was_handed_over_or_closed_cannot_be_handed_over(shared, tmp_path):
    journal, _, _ = shared
    with pytest.raises(JournalError, match="closed"):
        journal.hand_over(lambda _file: None)
    closed = TransitionJournal(tmp_path / "two.journal", session_id=ID, clock=ManualClock(), slots=128)
    closed.close()
    with pytest.raises(JournalError, match="closed"):
        closed.hand_over(lambda _file: None)


def test_what_is_handed_over_and_is_no_journal_is_refused(tmp_path):
    path = tmp_path / "none"
    path.write_bytes(b"x" * 8192)
    file = os.open(path, os.O_RDWR)
    with pytest.raises(JournalError, match="no journal"):
        ClientJournal(file)
    os.close(file)
