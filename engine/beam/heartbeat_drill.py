"""The heartbeat stands still, as if this process was killed: the receiver must drop the permit by itself.

The beam is permitted, then nothing is sent any more. The contact, seen by a second input, must open, and stay open
although heartbeats come again, until the permit was withdrawn once (docs/3-operate/beam.md, rules 1 and 2 for a
receiver). For commissioning and QA, with the accelerator made safe.

What the drill of the heartbeat needs: a line whose exchanges can be stopped, and another way to see its contact.

A killed process leaves its last permit and its last heartbeat in the receiver. Only the receiver can drop the permit
then, and the line's own read-back shows nothing any more. So the drill stops the exchanges and looks elsewhere.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from engine.beam.commissioning import POLL_NS, Pulser
from engine.core.clock import NS_PER_MS, Clock
from engine.core.errors import BeamLineError

RECEIVER_DROP_MS = 200.0
"""Longest time from the last heartbeat until a receiver has opened its contact (docs/3-operate/beam.md)."""

NOT_VERIFIABLE = "not verifiable: no second input configured"


LEAST_REPEATS = 3
"""Heartbeats that a receiver must have answered before its contact is said to stay open with them."""
MARGIN_MS = 50.0
"""Allowed beside `RECEIVER_DROP_MS` for the exchange before the standstill, the look, and threads that wake late."""
WAITED_NS = 500 * NS_PER_MS
"""How long the contact is waited for; then the receiver counts as one that does not drop the permit."""
WATCHED_NS = 60 * NS_PER_MS
"""How long an open contact is watched, without heartbeats and again with them."""
STOPPED_NS = 250 * NS_PER_MS
"""Longest wait for the exchange in progress."""


class StandingLine(Protocol):
    """A line that can stop its exchanges with the permit on, for the drill alone, never in a session.

    A standstill ends with the next hold from any thread, and by itself within a second.
    """

    def stand_still(self) -> None:
        """Send nothing more after the exchange in progress: permit and heartbeat stay as they are."""

    @property
    def still_since_ns(self) -> int | None:
        """Earliest time of the last heartbeat [ns]; None unless the line stands still with the permit on."""

    def repeat_permit(self) -> None:
        """Send heartbeats again, and with them the permit of before without withdrawing it, as a delayed write would.

        Ignored unless the line stands still.
        """

    @property
    def repeats(self) -> int:
        """How often the permit of before was sent again and answered; 0 unless the line stands still."""


class LookingLine(Protocol):
    """A line that reads its contact by its own connection, also while it stands still."""

    def reads_closed(self) -> bool:
        """Return the newest reading of the contact."""


class SecondInput(Protocol):
    """A way to see the receiver's contact that sends neither permit nor heartbeat; used by one thread."""

    def open(self) -> None:
        """Connect; raise BeamLineError where that fails."""

    def is_closed(self) -> bool:
        """Return whether the contact is closed; raise BeamLineError where it does not answer."""

    def close(self) -> None:
        """Disconnect; safe to call twice."""


class OwnInput:
    """`SecondInput` over the line's own connection, which only it may use: a serial port has one master."""

    def __init__(self, line: LookingLine) -> None:
        self._line = line

    def open(self) -> None:
        """Do nothing: the line is open."""

    def is_closed(self) -> bool:
        """Return the newest reading of the contact."""
        return self._line.reads_closed()

    def close(self) -> None:
        """Do nothing: the line stays open."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DrilledReceiver:
    """One receiver of a beam line.

    Attributes
    ----------
    name
        Kind of the line that leads to it, for messages.
    second_input
        Another way to see its contact; None where the site has configured none.
    """

    name: str
    line: StandingLine
    second_input: SecondInput | None


class NotVerifiableError(BeamLineError):
    """No second input shows the contact while nothing is exchanged."""

    code = BeamLineError.code


def check_verifiable(receivers: Sequence[DrilledReceiver]) -> None:
    """Raise NotVerifiableError unless there is a receiver, and each has a second input."""
    if not receivers:
        raise NotVerifiableError(NOT_VERIFIABLE)
    for receiver in receivers:
        if receiver.second_input is None:
            msg = f"{receiver.name}: {NOT_VERIFIABLE}"
            raise NotVerifiableError(msg)


class HeartbeatDrill:
    """Lets the heartbeat of one receiver after the other stand still; the pulser's line is open and armed."""

    def __init__(self, pulser: Pulser, clock: Clock, wait_ns: Callable[[int], None]) -> None:
        self._pulser, self._clock, self._wait_ns = pulser, clock, wait_ns

    def open_ms(self, receiver: DrilledReceiver) -> float:
        """Permit, stop the exchanges, and return the time from the last heartbeat to the open contact [ms].

        The caller holds, and arms the line again.

        Raises
        ------
        BeamLineError
            The contact stayed closed, or closed again, or cannot be seen.
        """
        check_verifiable([receiver])
        assert receiver.second_input is not None
        with _opened(receiver.second_input) as second_input, _named(receiver.name):
            if second_input.is_closed():
                msg = "the second input reads a closed contact though nothing is permitted"
                raise BeamLineError(msg)
            self._wait_ns(POLL_NS)  # the line refuses a permit with the same time stamp as a hold
            self._pulser.permit()
            self._expect_closed(second_input)
            return self._stand_still(receiver, second_input)

    def repeated_ms(self, receiver: DrilledReceiver, repeats: int) -> list[float]:
        """Do it ``repeats`` times, arming and holding the line each time; return the times to the open contact [ms].

        Raises
        ------
        BeamLineError
            As :meth:`open_ms`, or a contact opened later than `RECEIVER_DROP_MS` and `MARGIN_MS`.
        """
        taken_ms = []
        for _ in range(repeats):
            self._pulser.arm()
            try:
                taken_ms.append(self.open_ms(receiver))
            finally:
                self._pulser.hold()
            if taken_ms[-1] > RECEIVER_DROP_MS + MARGIN_MS:
                bound = f"at most {RECEIVER_DROP_MS:.0f} ms, and {MARGIN_MS:.0f} ms for the exchange and the look"
                opened = f"{receiver.name}: the contact opened {taken_ms[-1]:.0f} ms after the last heartbeat"
                msg = f"{opened}: must be {bound}"
                raise BeamLineError(msg)
        return taken_ms

    def _expect_closed(self, second_input: SecondInput) -> None:
        """Wait while the permit is renewed; an input that never shows it closed would prove nothing."""
        until_ns = self._clock.now_ns() + WAITED_NS
        while not second_input.is_closed():
            if self._clock.now_ns() >= until_ns:
                msg = "the second input does not see the contact close: is it wired to it?"
                raise BeamLineError(msg)
            self._pulser.renew()
            self._wait_ns(POLL_NS)
        self._pulser.renew()

    def _stand_still(self, receiver: DrilledReceiver, second_input: SecondInput) -> float:
        receiver.line.stand_still()
        since_ns = self._await_standstill(receiver)
        while second_input.is_closed():
            self._expect_still(receiver)
            if self._clock.now_ns() >= since_ns + WAITED_NS:
                msg = f"the contact stayed closed for {WAITED_NS // NS_PER_MS} ms after the heartbeat stood still"
                raise BeamLineError(msg)
            self._wait_ns(POLL_NS)
        opened_ns = self._clock.now_ns()
        self._expect_open(receiver, second_input, "closed again by itself after the heartbeat stood still")
        receiver.line.repeat_permit()
        failure = "closed again with the next heartbeats, though the permit had not been withdrawn once"
        self._await_repeats(receiver)
        self._expect_open(receiver, second_input, failure)
        return (opened_ns - since_ns) / NS_PER_MS

    def _await_standstill(self, receiver: DrilledReceiver) -> int:
        until_ns = self._clock.now_ns() + STOPPED_NS
        while (since_ns := receiver.line.still_since_ns) is None:
            if self._clock.now_ns() >= until_ns:
                msg = "the line did not stand still with the permit on"
                raise BeamLineError(msg)
            self._wait_ns(POLL_NS)
        return since_ns

    def _await_repeats(self, receiver: DrilledReceiver) -> None:
        """Wait until heartbeats were answered again: a contact that stays open without them shows nothing."""
        until_ns = self._clock.now_ns() + WAITED_NS
        while receiver.line.repeats < LEAST_REPEATS:
            self._expect_still(receiver)
            if self._clock.now_ns() >= until_ns:
                msg = f"no {LEAST_REPEATS} good answers to the heartbeats after the standstill"
                raise BeamLineError(msg)
            self._wait_ns(POLL_NS)

    def _expect_open(self, receiver: DrilledReceiver, second_input: SecondInput, failure: str) -> None:
        until_ns = self._clock.now_ns() + WATCHED_NS
        while True:
            is_closed = second_input.is_closed()
            self._expect_still(receiver)
            if is_closed:
                msg = f"the contact {failure}"
                raise BeamLineError(msg)
            if self._clock.now_ns() >= until_ns:
                return
            self._wait_ns(POLL_NS)

    def _expect_still(self, receiver: DrilledReceiver) -> None:
        """Raise BeamLineError where a hold or a fault ended the standstill: then the contact proves nothing."""
        if receiver.line.still_since_ns is None:
            msg = "the line was commanded while its heartbeat should have stood still"
            raise BeamLineError(msg)


@contextlib.contextmanager
def _opened(second_input: SecondInput) -> Iterator[SecondInput]:
    try:
        second_input.open()
        yield second_input
    finally:
        second_input.close()


@contextlib.contextmanager
def _named(name: str) -> Iterator[None]:
    try:
        yield
    except BeamLineError as error:
        msg = f"{name}: {error}"
        raise BeamLineError(msg) from error
