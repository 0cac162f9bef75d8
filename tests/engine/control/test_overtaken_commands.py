"""What was asked for before a hold or a disarming is not carried out after it, by whatever way it came late."""

import pytest

from engine.control.turn_inputs import CommandQueue
from engine.core.commands import Arm, Disarm, HoldBeam, ReleaseBeam
from engine.core.errors import CommandRefusedError

PAIRS = [(Arm, Disarm), (ReleaseBeam, HoldBeam)]


class StillClock:
    """Always the same time."""

    def now_ns(self) -> int:
        return 1_000


@pytest.fixture
def mailbox():
    return CommandQueue(clock=StillClock(), capacity=4)


@pytest.mark.parametrize(("undone", "by"), PAIRS)
@pytest.mark.parametrize("is_taken", [False, True])
def test_what_was_asked_for_earlier_and_comes_later_is_refused(mailbox, undone, by, is_taken):
    mailbox.submit(by(operator="ann"), submitted_ns=200)
    if is_taken:
        mailbox.take()
    with pytest.raises(CommandRefusedError, match="read the session, then retry"):
        mailbox.submit(undone(operator="bob"), submitted_ns=199)
    assert all(isinstance(letter.command, by) for letter in mailbox.take())


@pytest.mark.parametrize(("undone", "by"), PAIRS)
def test_what_was_asked_for_afterwards_is_carried_out(mailbox, undone, by):
    mailbox.submit(by(operator="ann"), submitted_ns=200)
    mailbox.submit(undone(operator="bob"), submitted_ns=201)
    assert [type(letter.command) for letter in mailbox.take()] == [by, undone]


@pytest.mark.parametrize(("undone", "by"), PAIRS)
def test_an_older_one_that_comes_late_does_not_make_the_newest_forgotten(mailbox, undone, by):
    mailbox.submit(by(operator="ann"), submitted_ns=200)
    mailbox.submit(by(operator="cid"), submitted_ns=100)
    with pytest.raises(CommandRefusedError):
        mailbox.submit(undone(operator="bob"), submitted_ns=150)
