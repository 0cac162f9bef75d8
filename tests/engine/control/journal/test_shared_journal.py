"""A journal that one process makes and another writes: its owner, its client, and who removes the file."""

import os

import pytest

from engine.control.journal.format import read_journal
from engine.control.journal.journal import RESERVED_SLOTS, ClientJournal, JournalError, OwnerJournal, TransitionJournal
from engine.core.clock import ManualClock
from tests.support.control.transitions import transition

ID = "0" * 32
SLOTS = RESERVED_SLOTS + 16


@pytest.fixture
def shared(tmp_path):
    """A journal, its owner's part and its client's; the file was handed over as a socket would."""
    journal = TransitionJournal(tmp_path / "one.journal", session_id=ID, clock=ManualClock(), slots=SLOTS)
    files = []
    owner = journal.hand_over(lambda file: files.append(os.dup(file)))
    client = ClientJournal(files[0])
    yield journal, owner, client
    client.close()


def test_what_the_client_writes_is_in_the_file_that_the_owner_made(shared):
    journal, _, client = shared
    assert (client.newest_committed, client.is_acknowledged, client.is_orphaned) == (0, True, False)
    assert [client.commit(transition(at_ns)) for at_ns in (5, 6)] == [1, 2]
    assert (client.newest_committed, client.is_acknowledged) == (2, False)
    kept = read_journal(journal.path.read_bytes())
    assert [entry.transition.at_ns for entry in kept.entries] == [5, 6]
    assert (kept.header.session_id, kept.damaged_slots, kept.missing_numbers) == (ID, (), ())


def test_a_client_is_behind_once_it_would_come_near_what_was_not_acknowledged(shared):
    _, _, client = shared
    for _ in range(SLOTS - RESERVED_SLOTS):
        client.commit(transition())
        assert not client.is_behind
    client.commit(transition())
    assert client.is_behind
    client.acknowledge(1)
    assert not client.is_behind


def test_a_client_that_is_closed_writes_nothing_more_and_leaves_the_file(shared):
    journal, _, client = shared
    client.commit(transition(5))
    file = client._file
    client.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(file)
    client.close()
    client.commit(transition(6))
    assert [entry.transition.at_ns for entry in read_journal(journal.path.read_bytes()).entries] == [5]


def test_the_owner_s_file_is_closed_when_it_was_sent(tmp_path):
    journal = TransitionJournal(tmp_path / "one.journal", session_id=ID, clock=ManualClock(), slots=SLOTS)
    sent = []
    owner = journal.hand_over(sent.append)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(sent[0])
    assert owner.path == journal.path


@pytest.mark.parametrize("acknowledged", [0, 1, 2])
def test_the_file_is_removed_once_all_entries_are_acknowledged(shared, acknowledged):
    journal, owner, client = shared
    client.commit(transition(5))
    client.commit(transition(6))
    journal.acknowledge(acknowledged)
    journal.acknowledge(0)
    assert owner.acknowledged == acknowledged
    assert owner.is_orphaned
    owner.client_closed(client.newest_committed)
    assert not journal.is_orphaned
    journal.close()
    assert journal.path.exists() is (acknowledged < 2)


def test_a_client_that_ended_without_its_last_number_leaves_the_file_to_be_read(shared):
    journal, _, client = shared
    client.commit(transition(5))
    journal.acknowledge(1)
    assert journal.is_orphaned
    journal.close()
    assert journal.path.exists(), "it may have written more than was acknowledged"


def test_a_client_that_committed_nothing_leaves_nothing_and_a_file_that_is_gone_is_no_error(shared):
    journal, owner, _ = shared
    owner.client_closed(0)
    journal.close()
    assert not journal.path.exists()
    owner.close()


def test_an_owner_knows_nothing_of_its_client_at_first(tmp_path):
    owner = OwnerJournal(tmp_path / "none")
    assert (owner.path, owner.acknowledged, owner.is_orphaned) == (tmp_path / "none", 0, True)
    owner.close()


def test_one_that_was_handed_over_or_closed_cannot_be_handed_over(shared, tmp_path):
    journal, _, _ = shared
    closed = TransitionJournal(tmp_path / "two.journal", session_id=ID, clock=ManualClock(), slots=SLOTS)
    closed.close()
    for one in (journal, closed):
        with pytest.raises(JournalError, match=r"^a journal that is closed cannot be handed over$"):
            one.hand_over(lambda _file: None)


def test_what_is_handed_over_and_is_no_journal_is_refused(tmp_path):
    path = tmp_path / "none"
    path.write_bytes(b"x" * 8192)
    file = os.open(path, os.O_RDWR)
    with pytest.raises(JournalError, match=r"^transitions cannot be kept safe from a kill: what was handed over is no"):
        ClientJournal(file)
    os.close(file)
