"""An engine in another process, as :class:`service.ports.RunningEngine`: nothing here decides, or waits for a frame.

The engine's process is told that the service lives by a beat from a thread of its own; what the writer has taken and
the audit confirmed goes with it. When that process dies the session has failed: its line lapses by itself, and what
its journal holds is still to be found.
"""

import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import replace
from typing import Generic, Protocol, TypeVar

from engine.clock import NS_PER_MS
from engine.commands import ActivateModel, Command
from engine.errors import CommandRefusedError
from engine.frames import ColorImage
from engine.likeness import Likeness
from engine.live import FrameRecord, GateTransition, LiveView, LoopStatus
from engine.mailbox import URGENT
from engine.model import MotionModel
from engine.notices import LearningNotice
from engine.permits import GateState, HoldReason
from engine.transition_journal import LentJournal
from service.engine_process.child import Child
from service.engine_process.crossing import CrossingClosedError
from service.engine_process.messages import (
    Answer,
    Beat,
    Farewell,
    Fault,
    News,
    Open,
    Opened,
    Order,
    Presence,
    Shown,
    Standing,
    Stop,
)
from service.engine_process.page import SLOTS
from service.errors import EngineProcessError
from service.ports import SessionPlan

logger = logging.getLogger(__name__)

BEAT_S = 0.03
OPEN_S = 30.0
STOP_S = 4.0
"""The engine's process gives its own thread three seconds, and says then that it hangs."""
FAREWELL_S = 20.0
SILENT_NS = 1_000 * NS_PER_MS
"""The other process tells something every 50 ms; whoever watches is told when it has been so long."""
LOOKS = 3
DOES_NOT_TAKE = "the engine's process takes no commands, and the beam line lapses by itself: stop the session"
"""It has not read for seconds, nor heard a beat for as long: it stands still, or its gate has faulted."""
OVER = "the session is over"
SILENT = "the engine's process does not answer"
T = TypeVar("T")


class Gone(Protocol):
    """Told once that a session's process has ended."""

    def __call__(self, *, is_lost: bool) -> None:
        """Hear it; ``is_lost`` when it was not to end yet."""


class Taken(queue.Queue[T], Generic[T]):
    """What has come of one of the engine's queues; counts what its reader takes, which alone makes room over there."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def _get(self) -> T:
        found: T = super()._get()
        self.count += 1
        return found


class Asking(Future[None]):
    """The answer to an order; who gives it up says so where the engine looks before it obeys."""

    def __init__(self, slot: int | None, give_up: Callable[[], None]) -> None:
        super().__init__()
        self.slot, self._give_up = slot, give_up

    def cancel(self) -> bool:
        """Give up: what was not begun by now is not done any more, unless it takes permission away."""
        self._give_up()
        return super().cancel()


class RemoteEngine:
    """See the module."""

    def __init__(self, child: Child, journal: LentJournal | None, *, on_gone: Gone) -> None:
        self._child, self._journal, self._on_gone = child, journal, on_gone
        self.samples: Taken[FrameRecord] = Taken()
        self.transitions: Taken[GateTransition] = Taken()
        self.notices: Taken[LearningNotice] = Taken()
        self.model: MotionModel | None = None
        self._standing = Standing()
        self._view: LiveView | None = None
        self._shown: Shown | None = None
        self._shown_silent: tuple[LiveView, LiveView] | None = None
        self._heard_ns = time.monotonic_ns()
        self._lock = threading.Lock()
        self._asked: dict[int, Asking] = {}
        self._free_slots = deque(range(SLOTS))
        self._orders = 0
        self._large: queue.SimpleQueue[Order | None] = queue.SimpleQueue()
        self._evidence: dict[str, object] | None = None
        self._killed_because: str | None = None
        self._is_over, self._has_evidence, self._is_gone = (threading.Event() for _ in range(3))

    def begin(self) -> None:
        """Begin to listen, and to beat."""
        for work, name in (
            (self._listen, "tidegate-engine-news"),
            (self._beat, "tidegate-engine-beat"),
            (self._send_large, "tidegate-engine-orders"),
        ):
            threading.Thread(target=work, name=name, daemon=True).start()

    @property
    def process_id(self) -> int:
        """The engine's process."""
        return self._child.process.pid

    def await_gone(self, seconds: float) -> None:
        """Wait for its process to end, and no longer than so."""
        self._is_gone.wait(seconds)

    @property
    def latest(self) -> LiveView | None:
        """The newest view; one that a silent process left behind is shown as a fault, for it is none of now."""
        view = self._view
        if view is None or self._is_over.is_set() or time.monotonic_ns() - self._heard_ns <= SILENT_NS:
            return view
        left_behind, shown = self._shown_silent or (None, None)
        if shown is None or left_behind is not view:  # one view for all who look: readers tell news by identity
            shown = _as_fault(view, HoldReason.WATCHDOG, SILENT)
            self._shown_silent = (view, shown)
        return shown

    def picture(self) -> tuple[int, ColorImage] | None:
        """Copy the newest colour picture; None before there is one."""
        for _ in range(LOOKS):
            shown = self._shown
            if shown is None or self._is_gone.is_set():
                return None
            picture = self._child.page.look(shown.number, shown.shape)
            if picture is not None:
                return shown.frame_index, picture
        return None

    @property
    def has_reference(self) -> bool:
        """Whether motion has a zero."""
        return self._standing.has_reference

    @property
    def likeness(self) -> Likeness | None:
        """How far the patient is from the stored model."""
        return self._standing.likeness

    @property
    def status(self) -> LoopStatus:
        """Where the engine's life stands; over only once all that it told has come."""
        return self._standing.status

    @property
    def error(self) -> str | None:
        """Why it failed."""
        return self._standing.error

    def submit(self, command: Command, *, submitted_ns: int | None = None) -> Future[None]:
        """Ask; in the order of asking, but for what is large, which nothing waits behind."""
        with self._lock:
            if self._is_over.is_set():
                raise CommandRefusedError(OVER)
            slot = None if isinstance(command, URGENT) else self._free_slot()
            number = self._orders = self._orders + 1
            asking = self._asked[number] = Asking(slot, lambda: self._give_up(number))
            asked_ns = time.monotonic_ns() if submitted_ns is None else submitted_ns
            order = Order(number=number, slot=asking.slot, command=command, submitted_ns=asked_ns)
            if isinstance(command, ActivateModel):
                self._large.put(order)
            elif not self._child.whisper.send(order):
                self._forget(number)
                raise CommandRefusedError(DOES_NOT_TAKE)
        return asking

    def _free_slot(self) -> int:
        if not self._free_slots:
            msg = f"{SLOTS} commands wait already: try again in a moment"
            raise CommandRefusedError(msg)
        slot = self._free_slots.popleft()
        self._child.page.begin(slot)
        return slot

    def _give_up(self, number: int) -> None:
        with self._lock:  # else its slot might be another order's by now
            asking = self._asked.get(number)
            if asking is not None and asking.slot is not None:
                self._child.page.give_up(asking.slot)

    def note_presence(self, operator: str) -> None:
        """Pass it on."""
        self._child.whisper.send(Presence(operator=operator))

    def report_fault(self, reason: HoldReason, detail: str) -> None:
        """Pass it on; a process that does not read it hears no beat either, and faults by itself."""
        self._child.whisper.send(Fault(reason=reason, detail=detail))

    def stop(self) -> None:
        """Hold the beam, then end; a process that does not is ended, and its line lapses."""
        self._child.whisper.send(Stop())
        if not self._is_over.wait(STOP_S):
            self._kill("the engine's process did not stop when told to: it was ended, and the beam is held")

    def evidence(self) -> dict[str, object]:
        """Return what the audit keeps of the tape; of a process that died only that it is torn."""
        if not self._has_evidence.wait(FAREWELL_S):
            self._kill("the engine's process did not end: it was ended")
        if self._evidence is None:
            return {"tape_sha256": None, "tape_torn": self._killed_because or "the engine's process died"}
        return self._evidence

    def _kill(self, why: str) -> None:
        self._killed_because = why
        self._child.kill()
        self._is_gone.wait(STOP_S)

    # Threads of their own, from here on.

    def _beat(self) -> None:
        while not self._is_gone.wait(BEAT_S):
            self._child.whisper.send(
                Beat(
                    alive_ns=time.monotonic_ns(),
                    samples=self.samples.count,
                    transitions=self.transitions.count,
                    notices=self.notices.count,
                    confirmed=0 if self._journal is None else self._journal.confirmed,
                )
            )

    def _send_large(self) -> None:
        with suppress(CrossingClosedError):
            while (order := self._large.get()) is not None:
                self._child.speech.send(order)

    def _listen(self) -> None:
        try:
            with suppress(CrossingClosedError):
                while not self._has_evidence.is_set():
                    self._hear(self._child.speech.receive())
        finally:
            self._end()

    def _hear(self, message: object) -> None:
        match message:
            case News():
                self._take(message)
            case Farewell():
                self._evidence = message.evidence
                if self._journal is not None:
                    self._journal.returned(message.newest_told)
                self._has_evidence.set()

    def _take(self, news: News) -> None:
        for record in news.samples:
            self.samples.put(record)
        for transition in news.transitions:
            self.transitions.put(transition)
        for notice in news.notices:
            self.notices.put(notice)
        self.model = news.model or self.model
        self._shown = news.shown or self._shown
        self._view = news.view or self._view
        self._heard_ns = time.monotonic_ns()
        self._standing = news.standing  # last: whoever sees the end finds everything there
        if news.standing.status.is_over:
            self._is_over.set()
        for answer in news.answers:
            self._answer(answer)

    def _answer(self, answer: Answer) -> None:
        with self._lock:
            asking = self._forget(answer.number)
        _resolve(asking, answer.error)

    def _forget(self, number: int) -> Asking:
        asking = self._asked.pop(number)
        if asking.slot is not None:
            self._free_slots.append(asking.slot)
        return asking

    def _end(self) -> None:
        """Bury the process; what it did not say is told for it."""
        status = self._child.bury()
        is_lost = not self._is_over.is_set()
        if is_lost:
            self._fail(self._killed_because or f"the engine's process died ({cause_of(status)}); the beam line lapses")
        self._is_over.set()
        self._has_evidence.set()
        self._is_gone.set()
        self._large.put(None)
        with self._lock:
            asked, self._asked = self._asked, {}
        for asking in asked.values():
            _resolve(asking, CommandRefusedError(OVER))
        self._on_gone(is_lost=is_lost)

    def _fail(self, why: str) -> None:
        logger.critical("%s", why)
        if self._view is not None:
            view = _as_fault(self._view, HoldReason.ENGINE_FAILED, why)
            self._view = replace(view, status=LoopStatus.FAILED, error=why)
        self._standing = replace(self._standing, status=LoopStatus.FAILED, error=why)


def begin_session(child: Child, plan: SessionPlan, *, on_gone: Gone) -> RemoteEngine:
    """Have a process that stands by begin a session; raise what it could not begin for."""
    try:
        lent = None if plan.journal is None else plan.journal.lend(child.whisper.send_file)
        opened = _opened(child, replace(plan, journal=None), has_journal=lent is not None)
    except BaseException as error:
        child.kill()
        status = child.bury()
        on_gone(is_lost=True)
        if not isinstance(error, CrossingClosedError):
            raise
        msg = f"the session's engine could not begin: its process died ({cause_of(status)})"
        raise EngineProcessError(msg) from error
    if opened.error is not None:
        if lent is not None:
            lent.returned(0)
        child.bury()
        on_gone(is_lost=False)
        raise opened.error
    engine = RemoteEngine(child, lent, on_gone=on_gone)
    engine.begin()
    return engine


def _opened(child: Child, plan: SessionPlan, *, has_journal: bool) -> Opened:
    child.speech.patience(OPEN_S)
    child.speech.send(Open(plan=plan, has_journal=has_journal, sent_ns=time.monotonic_ns()))
    opened: Opened = child.speech.receive()
    child.speech.patience(None)
    return opened


def _resolve(asking: Asking, error: BaseException | None) -> None:
    with suppress(InvalidStateError):  # whoever asked has given up
        if error is None:
            asking.set_result(None)
        else:
            asking.set_exception(error)


def _as_fault(view: LiveView, reason: HoldReason, detail: str) -> LiveView:
    """Show what was left behind: the line was held, or has lapsed, and nobody has read it back since."""
    record = replace(view.record, gate_state=GateState.FAULT, hold_reason=reason)
    return replace(view, record=record, is_armed=False, detail=detail)


def cause_of(status: int) -> str:
    """Say how a process ended."""
    return f"signal {-status}" if status < 0 else f"status {status}"
