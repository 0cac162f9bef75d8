"""A wired line: two threads of its own exchange with the hardware and supervise it, so that the engine never waits.

``permit`` and ``hold`` set the dead-man and wake the exchange thread, which sends the dead-man's state to the wire and
reads it back, every 20 ms. The watch thread checks from outside, because an exchange may hang in a driver. The first of
them to find the line late, silent or different from its command holds and latches it immediately; the engine raises the
fault at its next decision.

Three flags determine "is it on": what is due (the dead-man), what may be on (commanded on and not proved off since) and
what was read. Each is one attribute, written in one step.
"""

import contextlib
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias

from engine.beam.deadman import DeadMan, Grant
from engine.beam.line import TroubleListener, ignore_trouble
from engine.beam.wire.line_supervisor import (
    CYCLE_MS,
    GOOD_ANSWERS,
    WATCH_MS,
    LineSupervisor,
    LineTimes,
    ReadEdge,
    Trouble,
)
from engine.core.clock import NS_PER_MS, NS_PER_S, Clock
from engine.core.errors import BeamLineError, BeamLineMismatchError
from engine.core.gate_state import HoldReason, Lease
from engine.core.sentences import say

CYCLE_NS = int(CYCLE_MS * NS_PER_MS)
RECONNECT_NS = NS_PER_S // 4
CLOSE_S = 1.0
HEARTBEATS = 1 << 16
STILL_NS = NS_PER_S
"""Longest standstill for the drill of the heartbeat; then the line is commanded off."""

LOOK_NS = 5 * NS_PER_MS
"""Period of the looks at the contact meanwhile."""

Look: TypeAlias = Callable[[float], bool]
"""Reads the contact within so many seconds, and sends neither permit nor heartbeat."""


class Wire(Protocol):
    """Connection to a line's hardware, which may block; used by one thread at a time.

    Methods raise OSError or BeamLineError on failure; any other exception of a driver is treated as the same.
    """

    @property
    def name(self) -> str:
        """Name of the hardware, for messages."""

    def connect(self) -> None:
        """Connect, within a second."""

    def exchange(self, *, is_on: bool, heartbeat: int, within_s: float) -> bool:
        """Write the permit and the heartbeat, 0 to 65535; return what the line reads back."""

    def close(self) -> None:
        """Disconnect; safe to call twice."""


@dataclass(slots=True, kw_only=True)
class _Standstill:
    """A standstill that was asked for; it has begun once ``since_ns`` is set. Only the exchange thread looks."""

    until_ns: int
    since_ns: int | None = None
    repeats_permit: bool = False
    repeats: int = 0
    reads_closed: bool = True


class WiredBeamLine:
    """`BeamLine` over a wire, and `StandingLine` for the drill of the heartbeat.

    ``look`` reads the contact while the line stands still; None where that takes a connection of its own.
    """

    def __init__(self, wire: Wire, clock: Clock, times: LineTimes | None = None, *, look: Look | None = None) -> None:
        self.on_trouble: TroubleListener = ignore_trouble
        self._wire, self._clock, self._times = wire, clock, times or LineTimes()
        self._deadman = DeadMan()
        self._supervisor = LineSupervisor(self._times, now_ns=clock.now_ns())
        self._lock = threading.Lock()  # never taken by hold, nor during an exchange
        self._trouble: Trouble | None = None
        self._is_trouble_raised = True
        self._is_open = self._is_connected = False
        self._heartbeat = 0
        self._beaten_ns = clock.now_ns()
        self._look = look
        self._standstill: _Standstill | None = None  # taken away by hold, so that a hold wins every race with the drill
        self._wakeups: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._stop_requested = threading.Event()
        self._threads: tuple[threading.Thread, ...] = ()

    def open(self) -> None:
        """Connect, command off and read it back; raise BeamLineError where any of these fails."""
        now_ns = self._clock.now_ns()
        self._supervisor = LineSupervisor(self._times, now_ns=now_ns)
        self._trouble, self._is_trouble_raised = None, True
        self._deadman.hold(at_ns=now_ns, is_latching=True)
        try:
            self._wire.connect()
            self._is_connected = True
            reads_on = self._exchange()
        except Exception as error:
            self._drop()
            msg = f"{self._wire.name} does not answer: {_text_of(error)}"
            raise BeamLineError(msg) from error
        if reads_on or self._trouble is not None:
            self._drop()
            mismatch = say("{name} reads back on though nothing was permitted", name=self._wire.name)
            raise BeamLineMismatchError(mismatch) if reads_on else _error(self._trouble)
        self._is_open = True
        try:
            self._start_threads()
        except BaseException:  # too many threads: one must not run without the other
            self.close()
            self._drop()
            raise

    def rearm(self) -> None:
        """Accept permits again; raise BeamLineError unless the last answers were good and the line is off."""
        lost = self._latch_lost_thread()
        if lost:
            raise BeamLineError(lost)
        with self._lock:
            if not self._is_open or not self._supervisor.is_healthy(self._clock.now_ns()):
                raise _error(self._trouble)
            self._trouble, self._is_trouble_raised = None, True
            self._deadman.rearm()

    def permit(self, lease: Lease) -> None:
        """Command on until the lease ends; raise BeamLineError if the permit is refused."""
        self._refuse_closed()
        if self._trouble is not None:
            raise _error(self._trouble)
        grant = Grant(decided_ns=lease.granted_ns, expires_ns=lease.expires_ns, sequence=lease.sequence)
        self._deadman.grant(grant, now_ns=self._clock.now_ns())
        if not self._supervisor.commands_on:
            self._wakeups.put(None)

    def hold(self, reason: HoldReason) -> None:
        """Withdraw the permit; the exchange thread commands off at once."""
        self._deadman.hold(at_ns=self._clock.now_ns(), is_latching=reason.is_fault)
        self._standstill = None
        self._wakeups.put(None)

    def is_on(self) -> bool:
        """Return the read-back, or True while a hold is not proved yet; raise BeamLineError for a fault of the line.

        A fault is raised for as long as it lasts, and once if it has ended meanwhile.
        """
        self._refuse_closed()
        now_ns = self._clock.now_ns()
        self._latch_lost_thread()
        if self._supervisor.is_silent(now_ns):
            self._latch(
                Trouble(
                    reason=HoldReason.BEAM_LINE_FAILED,
                    detail=say("the exchanges with the line have stopped"),
                    at_ns=now_ns,
                )
            )
        trouble = self._trouble
        if trouble is not None and not (self._is_trouble_raised and self._supervisor.is_healthy(now_ns)):
            self._is_trouble_raised = True
            raise _error(trouble)
        return self._counts_as_on(now_ns)

    @property
    def is_settling(self) -> bool:
        """Whether the last command is not read back yet."""
        now_ns = self._clock.now_ns()
        return self._wants_on(now_ns) is not self._counts_as_on(now_ns)

    @property
    def edges(self) -> tuple[ReadEdge, ...]:
        """Commands that were read back, oldest first, as far as a bounded history reaches."""
        return tuple(self._supervisor.edges)

    @property
    def name(self) -> str:
        """Name of the hardware, for messages."""
        return self._wire.name

    @property
    def wire(self) -> Wire:
        """The wire, for what can be read of it without an exchange."""
        return self._wire

    @property
    def answers_ms(self) -> tuple[float, ...]:
        """Time of each answer, as far as a bounded history reaches [ms]."""
        return tuple(took_ns / NS_PER_MS for took_ns in tuple(self._supervisor.answers_ns))

    def close(self) -> None:
        """Hold, command off as far as the line still answers, and disconnect."""
        self.hold(HoldReason.ENGINE_STOPPED)
        self._is_open = False
        self._stop_requested.set()
        self._wakeups.put(None)
        for thread in self._threads:
            thread.join(CLOSE_S)
        self._threads = ()

    # The drill of the heartbeat.

    def stand_still(self) -> None:
        """Send nothing more after the exchange in progress, until the next hold or for `STILL_NS`."""
        self._standstill = _Standstill(until_ns=self._clock.now_ns() + STILL_NS)
        self._wakeups.put(None)

    @property
    def still_since_ns(self) -> int | None:
        """Earliest time of the last heartbeat [ns]; None unless the line stands still with the permit on."""
        standstill = self._standstill
        return None if standstill is None else standstill.since_ns

    def repeat_permit(self) -> None:
        """Send heartbeats again with the permit of before; ignored unless the line stands still."""
        standstill = self._standstill
        if standstill is not None:
            standstill.repeats_permit = True

    @property
    def repeats(self) -> int:
        """How often the permit of before was sent again and answered; 0 unless the line stands still."""
        standstill = self._standstill
        return 0 if standstill is None else standstill.repeats

    def reads_closed(self) -> bool:
        """Return the newest reading of the contact, also during a standstill if the line can look at it."""
        self._refuse_closed()
        standstill = self._standstill
        return self._supervisor.reads_on if standstill is None else standstill.reads_closed

    def _stand(self, standstill: _Standstill) -> None:
        """Begin the standstill if the permit is on and read back; then only look, or repeat the permit."""
        now_ns = self._clock.now_ns()
        is_on = self._wants_on(now_ns) and self._supervisor.commands_on and self._supervisor.reads_on
        if now_ns >= standstill.until_ns or (standstill.since_ns is None and not is_on):
            self._standstill = None
            self._exchange()
            return
        standstill.since_ns = standstill.since_ns or self._beaten_ns
        within_s = self._times.answer_ns / NS_PER_S
        if standstill.repeats_permit:
            self._heartbeat = (self._heartbeat + 1) % HEARTBEATS
            self._supervisor.begin(commands_on=True, now_ns=now_ns)
            if self._standstill is not standstill:  # held meanwhile; as in _choose_command
                self._exchange()
                return
            reads_on = self._wire.exchange(is_on=True, heartbeat=self._heartbeat, within_s=within_s)
            with self._lock:  # the contact is meant to differ from the command
                self._supervisor.answered(reads_on=reads_on, now_ns=self._clock.now_ns())
            standstill.reads_closed = reads_on
            standstill.repeats += 1
        elif self._look is not None:
            standstill.reads_closed = self._look(within_s)

    # The exchange thread.

    def exchange_once(self) -> None:
        """Send the dead-man's present state and read it back, or reconnect where the connection is lost."""
        if not self._is_connected:
            self._reconnect()
            return
        standstill = self._standstill
        try:
            if standstill is None:
                self._exchange()
            else:
                self._stand(standstill)
        except Exception as error:  # noqa: BLE001 - any exception of a driver means no answer
            self._fail(_text_of(error))

    def _exchange(self) -> bool:
        commands_on = self._choose_command()
        self._beaten_ns = self._clock.now_ns()
        within_s = self._times.answer_ns / NS_PER_S
        reads_on = self._wire.exchange(is_on=commands_on, heartbeat=self._next_heartbeat(), within_s=within_s)
        now_ns = self._clock.now_ns()
        with self._lock:
            trouble = self._supervisor.answered(reads_on=reads_on, now_ns=now_ns)
        self._latch(trouble)
        return reads_on

    def _choose_command(self) -> bool:
        """Note the next command, then check again: a hold in between sees the command or is seen here."""
        commands_on = False
        for _ in range(2):
            now_ns = self._clock.now_ns()
            with self._lock:
                commands_on = self._wants_on(now_ns) and self._supervisor.may_command_on(
                    held_at_ns=self._deadman.held_at_ns
                )
                self._supervisor.begin(commands_on=commands_on, now_ns=now_ns)
            if not commands_on:
                break
        return commands_on

    def _next_heartbeat(self) -> int:
        """Return the next count; the same one while the line is stuck on, so that a receiver drops the permit."""
        if self._trouble is None or not self._supervisor.reads_on:
            self._heartbeat = (self._heartbeat + 1) % HEARTBEATS
        return self._heartbeat

    def _fail(self, detail: str) -> None:
        """Latch, try once more to command off, and disconnect."""
        self._standstill = None
        now_ns = self._clock.now_ns()
        with self._lock:
            self._supervisor.failed(now_ns=now_ns)
        text = say("{name} does not answer: {detail}", name=self._wire.name, detail=detail)
        self._latch(Trouble(reason=HoldReason.BEAM_LINE_FAILED, detail=text, at_ns=now_ns))
        self._drop()

    def _drop(self) -> None:
        for step in (self._command_off, self._wire.close):
            with contextlib.suppress(Exception):
                step()
        self._is_connected = False

    def _command_off(self) -> None:
        if self._is_connected:
            within_s = self._times.answer_ns / NS_PER_S
            self._wire.exchange(is_on=False, heartbeat=self._heartbeat, within_s=within_s)

    def _reconnect(self) -> None:
        """Connect again; the next command is off, because the fault that disconnected has latched."""
        with contextlib.suppress(Exception):
            self._wire.connect()
            self._is_connected = True

    def rest_ns(self) -> int:
        """Time until the next exchange without a wake-up: the period, or the end of the lease [ns]."""
        now_ns = self._clock.now_ns()
        if self._standstill is not None:
            return LOOK_NS
        if self._supervisor.commands_on and not self._wants_on(now_ns):
            return 0  # the lease ended during the exchange
        longest_ns = CYCLE_NS if self._is_connected else RECONNECT_NS
        expires_ns = self._deadman.expires_ns
        return longest_ns if expires_ns is None or expires_ns <= now_ns else min(longest_ns, expires_ns - now_ns)

    def _rest(self) -> None:
        rest_ns = self.rest_ns()
        with contextlib.suppress(queue.Empty):
            self._wakeups.get(timeout=rest_ns / NS_PER_S)
            while True:
                self._wakeups.get_nowait()

    def _work(self) -> None:
        while not self._stop_requested.is_set():
            self.exchange_once()
            if not self._stop_requested.is_set():
                self._rest()
        self._drop()

    # The watch thread.

    def watch_once(self) -> None:
        """Hold and latch the line where it is overdue; not during a standstill, which is bounded in time."""
        now_ns = self._clock.now_ns()
        standstill = self._standstill
        if standstill is not None and standstill.since_ns is not None and now_ns < standstill.until_ns:
            return
        with self._lock:
            trouble = self._supervisor.check(wants_on=self._wants_on(now_ns), now_ns=now_ns)
        self._latch(trouble)

    def _watch(self) -> None:
        while not self._stop_requested.wait(WATCH_MS * NS_PER_MS / NS_PER_S):
            self.watch_once()

    def _start_threads(self) -> None:
        self._stop_requested = threading.Event()
        self._wakeups = queue.SimpleQueue()
        for target, name in ((self._work, "tidegate-beam-line"), (self._watch, "tidegate-beam-watch")):
            thread = threading.Thread(target=target, name=name, daemon=True)
            thread.start()
            self._threads = (*self._threads, thread)

    # State.

    def _wants_on(self, now_ns: int) -> bool:
        return self._trouble is None and self._is_open and self._deadman.is_on(now_ns)

    def _counts_as_on(self, now_ns: int) -> bool:
        return (
            self._supervisor.reads_on
            if self._wants_on(now_ns)
            else self._supervisor.may_be_on or self._supervisor.reads_on
        )

    def _latch(self, trouble: Trouble | None) -> None:
        """Hold and latch; the first cause is kept until it was raised once."""
        if trouble is None:
            return
        self._deadman.hold(at_ns=self._clock.now_ns(), is_latching=True)
        with self._lock:
            known = self._trouble
            if known is not None and (known.reason is trouble.reason or not self._is_trouble_raised):
                return
            self._trouble, self._is_trouble_raised = trouble, False
        self._wakeups.put(None)
        with contextlib.suppress(Exception):  # an error of the listener must not end the line's threads
            self.on_trouble(trouble.reason, trouble.detail)

    def _latch_lost_thread(self) -> str:
        """Latch and return the fault where a thread of the line has died; only opening the line again ends it."""
        lost = [thread.name for thread in self._threads if not thread.is_alive()]
        if not lost:
            return ""
        text = f"a thread of the beam line has died: {', '.join(lost)}"
        self._latch(Trouble(reason=HoldReason.BEAM_LINE_FAILED, detail=text, at_ns=self._clock.now_ns()))
        return text

    def _refuse_closed(self) -> None:
        if not self._is_open:
            msg = "the line is closed"
            raise BeamLineError(msg)


def _error(trouble: Trouble | None) -> BeamLineError:
    if trouble is None:
        return BeamLineError(
            say(
                "the beam line has given fewer than {good_answers} good answers in a row yet", good_answers=GOOD_ANSWERS
            )
        )
    is_mismatch = trouble.reason is HoldReason.BEAM_LINE_MISMATCH
    return (BeamLineMismatchError if is_mismatch else BeamLineError)(trouble.detail)


def _text_of(error: Exception) -> str:
    return str(error) or type(error).__name__
