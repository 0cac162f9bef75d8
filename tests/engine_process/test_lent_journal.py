"""A journal that one process makes and another writes: the lock goes along, and only what is confirmed is removed."""

import os

import pytest

from engine.clock import ManualClock
from engine.journal_slots import read_kept
from engine.live import GateTransition
from engine.permits import GateState
from engine.transition_journal import BorrowedJournal, JournalError, TransitionJournal
from service.journals import read_unless_in_use

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
def lent(tmp_path):
    """A journal, the part of it that stays, and the part that went; its file was handed over as a socket would."""
    journal = TransitionJournal(tmp_path / "one.journal", session_id=ID, clock=ManualClock(), slots=128)
    files = []
    stays = journal.lend(lambda file: files.append(os.dup(file)))
    gone = BorrowedJournal(files[0])
    yield journal, stays, gone
    gone.close()


def test_what_the_other_process_writes_is_in_the_file_that_this_one_made(lent):
    journal, _, gone = lent
    assert [gone.write(_transition(at_ns)) for at_ns in (5, 6)] == [1, 2]
    kept = read_kept(journal.path.read_bytes())
    assert [entry.transition.at_ns for entry in kept.entries] == [5, 6]
    assert (kept.header.session_id, kept.damaged_slots, kept.missing_numbers) == (ID, (), ())


def test_it_is_in_use_until_the_other_process_is_done_with_it_and_no_longer(lent):
    journal, _, gone = lent
    assert read_unless_in_use(journal.path, patience_s=0.0) is None
    gone.close()
    assert read_unless_in_use(journal.path, patience_s=0.0) is not None


def test_a_start_waits_a_while_for_an_engine_that_is_on_its_way_out(lent, monkeypatch):
    journal, _, gone = lent
    monkeypatch.setattr("service.journals.time.sleep", lambda _s: gone.close())
    assert read_unless_in_use(journal.path, patience_s=60.0) is not None


@pytest.mark.parametrize("confirmed", [0, 1, 2])
def test_the_file_goes_once_all_that_was_told_is_confirmed(lent, confirmed):
    journal, stays, gone = lent
    gone.write(_transition(5))
    gone.write(_transition(6))
    journal.confirm(confirmed)
    assert stays.confirmed == confirmed
    stays.returned(gone.newest_told)
    assert not journal.is_orphaned
    journal.close()
    assert journal.path.exists() is (confirmed < 2)


def test_a_writer_that_never_said_how_far_it_came_leaves_the_file_to_be_read(lent):
    journal, _, gone = lent
    gone.write(_transition(5))
    journal.confirm(1)
    assert journal.is_orphaned
    journal.close()
    assert journal.path.exists(), "it may have written more than was heard"


def test_one_that_was_handed_over_or_closed_cannot_be_handed_over(lent, tmp_path):
    journal, _, _ = lent
    with pytest.raises(JournalError, match="closed"):
        journal.lend(lambda _file: None)
    closed = TransitionJournal(tmp_path / "two.journal", session_id=ID, clock=ManualClock(), slots=128)
    closed.close()
    with pytest.raises(JournalError, match="closed"):
        closed.lend(lambda _file: None)


def test_what_is_handed_over_and_is_no_journal_is_refused(tmp_path):
    path = tmp_path / "none"
    path.write_bytes(b"x" * 8192)
    file = os.open(path, os.O_RDWR)
    with pytest.raises(JournalError, match="no journal"):
        BorrowedJournal(file)
    os.close(file)
