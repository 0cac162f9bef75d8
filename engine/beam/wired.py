"""A line at the end of a wire that takes its time: told and asked by threads of its own, so that nobody waits for it.

``permit`` and ``hold`` set the dead-man and ring; the exchanger tells the wire what the dead-man says at that moment,
and reads it back, every 20 ms. The watcher looks from beside, for the exchanger may hang in a driver. Whichever finds
the line late, silent or contrary holds and latches it there and then; the engine hears of it at its next decision.

Three flags answer "is it on": what is wanted (the dead-man), what may be on (told on, and not proved off since) and
what was read. Each is one attribute, written in one step.
"""

import contextlib
import queue
import threading
from typing import Protocol

from engine.beam.deadman import DeadMan, Grant
from engine.beam.judge import CYCLE_MS, WATCH_MS, LineJudge, LineTimes, ReadEdge, Trouble
from engine.beam.line import TroubleListener, tell_nobody
from engine.clock import NS_PER_MS, NS_PER_S, Clock
from engine.errors import BeamLineError, BeamLineMismatchError
from engine.permits import HoldReason, Lease

CYCLE_NS = int(CYCLE_MS * NS_PER_MS)
RECONNECT_NS = NS_PER_S // 4
CLOSE_S = 1.0
HEARTBEATS = 1 << 16


class Wire(Protocol):
    """A way to a line's hardware that may block; owned by one thread at a time.

    Everything raises OSError or BeamLineError where it fails; whatever else a driver raises is taken for the same.
    """

    @property
    def name(self) -> str:
        """What it leads to, for a person."""

    def connect(self) -> None:
        """Connect, within a second."""

    def exchange(self, *, is_on: bool, heartbeat: int, within_s: float) -> bool:
        """Write the permit and the heartbeat, 0 to 65535; return what the line reads back."""

    def close(self) -> None:
        """Disconnect; safe to call twice."""


class WiredBeamLine:
    """Acts as `BeamLine` over a wire."""

    def __init__(self, wire: Wire, clock: Clock, times: LineTimes | None = None) -> None:
        self.on_trouble: TroubleListener = tell_nobody
        self._wire, self._clock, self._times = wire, clock, times or LineTimes()
        self._deadman = DeadMan()
        self._judge = LineJudge(self._times, now_ns=clock.now_ns())
        self._judging = threading.Lock()  # never taken by hold, nor while a wire is waited for
        self._trouble: Trouble | None = None
        self._is_trouble_told = True
        self._is_open = self._is_connected = False
        self._heartbeat = 0
        self._bell: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._stop_requested = threading.Event()
        self._threads: tuple[threading.Thread, ...] = ()

    def open(self) -> None:
        """Connect, tell off and read it back; raise BeamLineError where any of it fails."""
        now_ns = self._clock.now_ns()
        self._judge = LineJudge(self._times, now_ns=now_ns)
        self._trouble, self._is_trouble_told = None, True
        self._deadman.hold(at_ns=now_ns, is_latching=True)
        try:
            self._wire.connect()
            self._is_connected = True
            reads_on = self._told_and_read()
        except Exception as error:
            self._drop()
            msg = f"{self._wire.name} does not answer: {_worded(error)}"
            raise BeamLineError(msg) from error
        if reads_on or self._trouble is not None:
            self._drop()
            otherwise = f"{self._wire.name} reads back on though nothing was permitted"
            raise BeamLineMismatchError(otherwise) if reads_on else _error(self._trouble)
        self._is_open = True
        try:
            self._start_threads()
        except BaseException:  # too many threads: whichever runs must not go on alone
            self.close()
            self._drop()
            raise

    def rearm(self) -> None:
        """Accept permits again; raise BeamLineError unless the line has answered well lately and is off."""
        lost = self._latch_lost_thread()
        if lost:
            raise BeamLineError(lost)
        with self._judging:
            if not self._is_open or not self._judge.is_healthy(self._clock.now_ns()):
                raise _error(self._trouble)
            self._trouble, self._is_trouble_told = None, True
            self._deadman.rearm()

    def permit(self, lease: Lease) -> None:
        """Let the line be told on until the lease ends; raise BeamLineError if it is refused."""
        self._refuse_closed()
        if self._trouble is not None:
            raise _error(self._trouble)
        grant = Grant(decided_ns=lease.granted_ns, expires_ns=lease.expires_ns, sequence=lease.sequence)
        self._deadman.grant(grant, now_ns=self._clock.now_ns())
        if not self._judge.tells_on:
            self._bell.put(None)

    def hold(self, reason: HoldReason) -> None:
        """Take the permit back; the exchanger tells the line at once."""
        self._deadman.hold(at_ns=self._clock.now_ns(), is_latching=reason.is_fault)
        self._bell.put(None)

    def is_on(self) -> bool:
        """Say what was read back, or what may be on where a hold is not proved yet; raise where the line is in trouble.

        A trouble is raised for as long as it lasts, and once where it is over already.
        """
        self._refuse_closed()
        now_ns = self._clock.now_ns()
        self._latch_lost_thread()
        if self._judge.is_silent(now_ns):
            self._latch(Trouble(reason=HoldReason.BEAM_LINE_FAILED, detail="nobody asks the line", at_ns=now_ns))
        trouble = self._trouble
        if trouble is not None and not (self._is_trouble_told and self._judge.is_healthy(now_ns)):
            self._is_trouble_told = True
            raise _error(trouble)
        return self._counts_as_on(now_ns)

    @property
    def is_settling(self) -> bool:
        """Whether what is wanted was not read back yet."""
        now_ns = self._clock.now_ns()
        return self._wants_on(now_ns) is not self._counts_as_on(now_ns)

    @property
    def edges(self) -> tuple[ReadEdge, ...]:
        """Orders that were read back, oldest first, as far as a bounded history reaches."""
        return tuple(self._judge.edges)

    @property
    def name(self) -> str:
        """What is at the other end, for a person."""
        return self._wire.name

    @property
    def answers_ms(self) -> tuple[float, ...]:
        """How long each answer took, as far as a bounded history reaches [ms]."""
        return tuple(took_ns / NS_PER_MS for took_ns in tuple(self._judge.answers_ns))

    def close(self) -> None:
        """Hold, tell the line off as far as it still listens, and disconnect."""
        self.hold(HoldReason.ENGINE_STOPPED)
        self._is_open = False
        self._stop_requested.set()
        self._bell.put(None)
        for thread in self._threads:
            thread.join(CLOSE_S)
        self._threads = ()

    # The exchanger.

    def exchange_once(self) -> None:
        """Tell the wire what the dead-man says now, and read it back; connect first where that is to be done."""
        if not self._is_connected:
            self._reconnect()
            return
        try:
            self._told_and_read()
        except Exception as error:  # noqa: BLE001 - whatever a driver raises, the line does not answer
            self._give_up(_worded(error))

    def _told_and_read(self) -> bool:
        tells_on = self._announce()
        within_s = self._times.answer_ns / NS_PER_S
        reads_on = self._wire.exchange(is_on=tells_on, heartbeat=self._next_heartbeat(), within_s=within_s)
        now_ns = self._clock.now_ns()
        with self._judging:
            trouble = self._judge.answered(reads_on=reads_on, now_ns=now_ns)
        self._latch(trouble)
        return reads_on

    def _announce(self) -> bool:
        """Note what is about to be told, then look again: a hold that comes meanwhile sees it or is seen."""
        tells_on = False
        for _ in range(2):
            now_ns = self._clock.now_ns()
            with self._judging:
                tells_on = self._wants_on(now_ns) and self._judge.may_tell_on(held_at_ns=self._deadman.held_at_ns)
                self._judge.begin(tells_on=tells_on, now_ns=now_ns)
            if not tells_on:
                break
        return tells_on

    def _next_heartbeat(self) -> int:
        """Count up; not while the line is stuck on, so that a receiver which watches the heartbeat drops it."""
        if self._trouble is None or not self._judge.reads_on:
            self._heartbeat = (self._heartbeat + 1) % HEARTBEATS
        return self._heartbeat

    def _give_up(self, detail: str) -> None:
        """Latch, try once more to tell off, and disconnect."""
        now_ns = self._clock.now_ns()
        with self._judging:
            self._judge.failed(now_ns=now_ns)
        text = f"{self._wire.name} does not answer: {detail}"
        self._latch(Trouble(reason=HoldReason.BEAM_LINE_FAILED, detail=text, at_ns=now_ns))
        self._drop()

    def _drop(self) -> None:
        for last in (self._tell_off, self._wire.close):
            with contextlib.suppress(Exception):
                last()
        self._is_connected = False

    def _tell_off(self) -> None:
        if self._is_connected:
            within_s = self._times.answer_ns / NS_PER_S
            self._wire.exchange(is_on=False, heartbeat=self._heartbeat, within_s=within_s)

    def _reconnect(self) -> None:
        """Connect again; what is told then is off, for the trouble that disconnected has latched."""
        with contextlib.suppress(Exception):
            self._wire.connect()
            self._is_connected = True

    def rest_ns(self) -> int:
        """How long nothing is to be told unless somebody rings: until the next cycle, or the end of the lease."""
        now_ns = self._clock.now_ns()
        if self._judge.tells_on and not self._wants_on(now_ns):
            return 0  # the lease ended while the line was told
        longest_ns = CYCLE_NS if self._is_connected else RECONNECT_NS
        expires_ns = self._deadman.expires_ns
        return longest_ns if expires_ns is None or expires_ns <= now_ns else min(longest_ns, expires_ns - now_ns)

    def _rest(self) -> None:
        rest_ns = self.rest_ns()
        with contextlib.suppress(queue.Empty):
            self._bell.get(timeout=rest_ns / NS_PER_S)
            while True:
                self._bell.get_nowait()

    def _work(self) -> None:
        while not self._stop_requested.is_set():
            self.exchange_once()
            if not self._stop_requested.is_set():
                self._rest()
        self._drop()

    # The watcher.

    def watch_once(self) -> None:
        """Hold and latch a line that is overdue."""
        now_ns = self._clock.now_ns()
        with self._judging:
            trouble = self._judge.check(wants_on=self._wants_on(now_ns), now_ns=now_ns)
        self._latch(trouble)

    def _watch(self) -> None:
        while not self._stop_requested.wait(WATCH_MS * NS_PER_MS / NS_PER_S):
            self.watch_once()

    def _start_threads(self) -> None:
        self._stop_requested = threading.Event()
        self._bell = queue.SimpleQueue()
        for target, name in ((self._work, "tidegate-beam-line"), (self._watch, "tidegate-beam-watch")):
            thread = threading.Thread(target=target, name=name, daemon=True)
            thread.start()
            self._threads = (*self._threads, thread)

    # What is so.

    def _wants_on(self, now_ns: int) -> bool:
        return self._trouble is None and self._is_open and self._deadman.is_on(now_ns)

    def _counts_as_on(self, now_ns: int) -> bool:
        return self._judge.reads_on if self._wants_on(now_ns) else self._judge.may_be_on or self._judge.reads_on

    def _latch(self, trouble: Trouble | None) -> None:
        """Hold for good, whoever found it; the first cause stays on show until it was told."""
        if trouble is None:
            return
        self._deadman.hold(at_ns=self._clock.now_ns(), is_latching=True)
        with self._judging:
            shown = self._trouble
            if shown is not None and (shown.reason is trouble.reason or not self._is_trouble_told):
                return
            self._trouble, self._is_trouble_told = trouble, False
        self._bell.put(None)
        with contextlib.suppress(Exception):  # whoever listens, the line's own threads go on
            self.on_trouble(trouble.reason, trouble.detail)

    def _latch_lost_thread(self) -> str:
        """Latch where one of the line's own threads is no more, and say so; only to open the line again mends that."""
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
        return BeamLineError("the beam line has not answered well for long enough yet")
    is_mismatch = trouble.reason is HoldReason.BEAM_LINE_MISMATCH
    return (BeamLineMismatchError if is_mismatch else BeamLineError)(trouble.detail)


def _worded(error: Exception) -> str:
    return str(error) or type(error).__name__
