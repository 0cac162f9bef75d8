"""An engine in another process, as :class:`service.engine_host.protocols.RunningEngine`.

Nothing here decides, or waits for a frame.

A thread of its own sends heartbeats, with the web server's last turn and the totals that the writer has taken and the
audit has committed. When the engine process dies the session has failed: its beam line's lease expires, and the next
start recovers its journal.
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

from engine.control import (
    URGENT,
    Command,
    EngineStatus,
    FrameRecord,
    GateTransition,
    LiveView,
    LoopStatus,
    OwnerJournal,
)
from engine.core.clock import NS_PER_MS
from engine.core.commands import ActivateModel
from engine.core.errors import CommandRefusedError
from engine.core.frames import ColorImage
from engine.core.gate_state import GateState, HoldReason
from engine.core.learning_status import LearningEvent
from service.core.errors import EngineProcessError
from service.engine_host.process.channels import SLOTS, ChannelClosedError
from service.engine_host.process.messages import (
    ChildProcess,
    CommandMessage,
    CommandResult,
    EngineUpdate,
    Fault,
    FinalReport,
    Heartbeat,
    Open,
    Opened,
    Presence,
    Stop,
)
from service.engine_host.protocols import SessionPlan

logger = logging.getLogger(__name__)

HEARTBEAT_S = 0.03
OPEN_S = 30.0
STOP_S = 4.0
"""The engine process gives its own thread three seconds and reports then that it hangs."""
FINAL_REPORT_S = 20.0
SILENT_NS = 1_000 * NS_PER_MS
"""The engine process sends an update every 50 ms; after this silence its view is shown as a fault."""
NOT_READING = "the engine's process takes no commands, and the beam line lapses by itself: stop the session"
"""It has not read for seconds and so received no heartbeat either: it is stopped, or its gate has faulted."""
OVER = "the session is over"
SILENT = "the engine's process does not answer"
T = TypeVar("T")


class EndCallback(Protocol):
    """Called once when a session's process has ended."""

    def __call__(self, *, is_lost: bool) -> None:
        """Handle the end; ``is_lost`` where the process ended before its session."""


class CountingQueue(queue.Queue[T], Generic[T]):
    """The service's copy of an engine queue; counts what its reader takes, which makes room in the engine's queue."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def _get(self) -> T:
        found: T = super()._get()
        self.count += 1
        return found


class PendingCommand(Future[None]):
    """The future of a command; cancelling sets the flag that the engine reads before it executes the command."""

    def __init__(self, slot: int | None, mark_cancelled: Callable[[], None]) -> None:
        super().__init__()
        self.slot, self._cancel = slot, mark_cancelled

    def cancel(self) -> bool:
        """Cancel the command unless its execution has begun, or it takes permission away."""
        self._cancel()
        return super().cancel()


class RemoteEngine:
    """Commands, queues and status of the engine process, safe from any thread.

    ``server_turned_ns`` returns when the web server's event loop last turned [ns, host monotonic].
    """

    def __init__(
        self,
        child: ChildProcess,
        journal: OwnerJournal | None,
        *,
        on_end: EndCallback,
        server_turned_ns: Callable[[], int],
    ) -> None:
        self._child, self._journal, self._on_end = child, journal, on_end
        self._server_turned_ns = server_turned_ns
        self.samples: CountingQueue[FrameRecord] = CountingQueue()
        self.transitions: CountingQueue[GateTransition] = CountingQueue()
        self.notices: CountingQueue[LearningEvent] = CountingQueue()
        self._status = EngineStatus()
        self._silent_view: tuple[LiveView, LiveView] | None = None
        self._updated_ns = time.monotonic_ns()
        self._lock = threading.Lock()
        self._pending: dict[int, PendingCommand] = {}
        self._free_slots = deque(range(SLOTS))
        self._last_number = 0
        self._large: queue.SimpleQueue[CommandMessage | None] = queue.SimpleQueue()
        self._evidence: dict[str, object] | None = None
        self._killed_because: str | None = None
        self._is_over, self._has_evidence, self._has_ended = (threading.Event() for _ in range(3))

    def begin(self) -> None:
        """Start the threads that receive updates and send heartbeats and large commands."""
        for work, name in (
            (self._receive_updates, "tidegate-engine-updates"),
            (self._send_heartbeats, "tidegate-engine-heartbeat"),
            (self._send_large, "tidegate-engine-commands"),
        ):
            threading.Thread(target=work, name=name, daemon=True).start()

    @property
    def process_id(self) -> int:
        """Id of the engine process."""
        return self._child.process.pid

    def await_end(self, seconds: float) -> None:
        """Wait at most so long for the engine process to end [s]."""
        self._has_ended.wait(seconds)

    @property
    def status(self) -> EngineStatus:
        """The status last received; the view of a silent process is replaced by a fault, because it is not current.

        It is over only once everything that the process sent has been applied.
        """
        status = self._status
        view = status.view
        if view is None or self._is_over.is_set() or time.monotonic_ns() - self._updated_ns <= SILENT_NS:
            return status
        left_behind, shown = self._silent_view or (None, None)
        if shown is None or left_behind is not view:  # one object for all readers, who compare views by identity
            shown = _as_fault(view, HoldReason.WATCHDOG, SILENT)
            self._silent_view = (view, shown)
        return replace(status, view=shown)

    def picture(self) -> tuple[int, ColorImage] | None:
        """Copy the newest colour picture; None before there is one, and after the end."""
        return None if self._has_ended.is_set() else self._child.page.read_picture()

    def submit(self, command: Command, *, submitted_ns: int | None = None) -> Future[None]:
        """Send a command; in order of submission, except large ones, which must not delay others."""
        with self._lock:
            if self._is_over.is_set():
                raise CommandRefusedError(OVER)
            slot = None if isinstance(command, URGENT) else self._free_slot()
            number = self._last_number = self._last_number + 1
            pending = self._pending[number] = PendingCommand(slot, lambda: self._cancel(number))
            asked_ns = time.monotonic_ns() if submitted_ns is None else submitted_ns
            message = CommandMessage(number=number, slot=pending.slot, command=command, submitted_ns=asked_ns)
            if isinstance(command, ActivateModel):
                self._large.put(message)
            elif not self._child.control.send(message):
                self._remove(number)
                raise CommandRefusedError(NOT_READING)
        return pending

    def _free_slot(self) -> int:
        if not self._free_slots:
            msg = f"{SLOTS} commands wait already: try again in a moment"
            raise CommandRefusedError(msg)
        slot = self._free_slots.popleft()
        self._child.page.clear(slot)
        return slot

    def _cancel(self, number: int) -> None:
        with self._lock:  # else the slot might belong to another command by now
            pending = self._pending.get(number)
            if pending is not None and pending.slot is not None:
                self._child.page.mark_cancelled(pending.slot)

    def note_presence(self, operator: str) -> None:
        """Send the operator's presence; never waits."""
        self._child.control.send(Presence(operator=operator))

    def report_fault(self, reason: HoldReason, detail: str) -> None:
        """Send the fault; a process that does not read receives no heartbeat either, and faults by itself."""
        self._child.control.send(Fault(reason=reason, detail=detail))

    def stop(self) -> None:
        """Hold the beam, then end the session; kill a process that does not stop, whose line's lease then expires."""
        self._child.control.send(Stop())
        if not self._is_over.wait(STOP_S):
            self._kill("the engine process did not stop in time: it was killed, and the beam is held")

    def evidence(self) -> dict[str, object]:
        """Return what the audit records of the tape; of a process that died, only that the tape is torn."""
        if not self._has_evidence.wait(FINAL_REPORT_S):
            self._kill("the engine process did not end in time: it was killed")
        if self._evidence is None:
            return {"tape_sha256": None, "tape_torn": self._killed_because or "the engine's process died"}
        return self._evidence

    def _kill(self, why: str) -> None:
        self._killed_because = why
        self._child.kill()
        self._has_ended.wait(STOP_S)

    # From here on: called in this object's own threads.

    def _send_heartbeats(self) -> None:
        while not self._has_ended.wait(HEARTBEAT_S):
            self._child.control.send(
                Heartbeat(
                    alive_ns=self._server_turned_ns(),
                    samples=self.samples.count,
                    transitions=self.transitions.count,
                    notices=self.notices.count,
                    acknowledged=0 if self._journal is None else self._journal.acknowledged,
                )
            )

    def _send_large(self) -> None:
        with suppress(ChannelClosedError):
            while (message := self._large.get()) is not None:
                self._child.bulk.send(message)

    def _receive_updates(self) -> None:
        try:
            with suppress(ChannelClosedError):
                while not self._has_evidence.is_set():
                    self._handle(self._child.bulk.receive())
        finally:
            self._end()

    def _handle(self, message: object) -> None:
        match message:
            case EngineUpdate():
                self._apply(message)
            case FinalReport():
                self._evidence = message.evidence
                if self._journal is not None:
                    self._journal.client_closed(message.newest_committed)
                self._has_evidence.set()

    def _apply(self, update: EngineUpdate) -> None:
        for record in update.samples:
            self.samples.put(record)
        for transition in update.transitions:
            self.transitions.put(transition)
        for notice in update.notices:
            self.notices.put(notice)
        self._status = _merged(self._status, update.status)  # last: a reader of the end finds all items in the queues
        self._updated_ns = time.monotonic_ns()
        if update.status.is_over:
            self._is_over.set()
        for answer in update.answers:
            self._answer(answer)

    def _answer(self, answer: CommandResult) -> None:
        with self._lock:
            pending = self._remove(answer.number)
        _resolve(pending, answer.error)

    def _remove(self, number: int) -> PendingCommand:
        pending = self._pending.pop(number)
        if pending.slot is not None:
            self._free_slots.append(pending.slot)
        return pending

    def _end(self) -> None:
        """Reap the child process and fail its pending commands."""
        status = self._child.reap()
        is_lost = not self._is_over.is_set()
        if is_lost:
            self._fail(self._killed_because or f"the engine's process died ({cause_of(status)}); the beam line lapses")
        self._is_over.set()
        self._has_evidence.set()
        self._has_ended.set()
        self._large.put(None)
        with self._lock:
            unanswered, self._pending = self._pending, {}
        for pending in unanswered.values():
            _resolve(pending, CommandRefusedError(OVER))
        self._on_end(is_lost=is_lost)

    def _fail(self, why: str) -> None:
        logger.critical("%s", why)
        status = replace(self._status, run_state=LoopStatus.FAILED, error=why)
        if status.view is not None:
            view = _as_fault(status.view, HoldReason.ENGINE_FAILED, why)
            status = replace(status, view=replace(view, status=LoopStatus.FAILED, error=why))
        self._status = status


def begin_session(
    child: ChildProcess, plan: SessionPlan, *, on_end: EndCallback, server_turned_ns: Callable[[], int]
) -> RemoteEngine:
    """Start a session in a standby process; raise what prevented it."""
    try:
        owned = None if plan.journal is None else plan.journal.hand_over(child.control.send_file)
        opened = _request_open(child, replace(plan, journal=None), has_journal=owned is not None)
    except BaseException as error:
        child.kill()
        status = child.reap()
        on_end(is_lost=True)
        if not isinstance(error, ChannelClosedError):
            raise
        msg = f"the session's engine could not start: its process died ({cause_of(status)})"
        raise EngineProcessError(msg) from error
    if opened.error is not None:
        if owned is not None:
            owned.client_closed(0)
        child.reap()
        on_end(is_lost=False)
        raise opened.error
    engine = RemoteEngine(child, owned, on_end=on_end, server_turned_ns=server_turned_ns)
    engine.begin()
    return engine


def _request_open(child: ChildProcess, plan: SessionPlan, *, has_journal: bool) -> Opened:
    child.bulk.set_timeout(OPEN_S)
    child.bulk.send(Open(plan=plan, has_journal=has_journal, sent_ns=time.monotonic_ns()))
    opened: Opened = child.bulk.receive()
    child.bulk.set_timeout(None)
    return opened


def _resolve(pending: PendingCommand, error: BaseException | None) -> None:
    with suppress(InvalidStateError):  # cancelled meanwhile
        if error is None:
            pending.set_result(None)
        else:
            pending.set_exception(error)


def _merged(before: EngineStatus, status: EngineStatus) -> EngineStatus:
    """Return the new status, with the earlier view and model where the update omits them as unchanged."""
    learning = replace(status.learning, model=status.learning.model or before.learning.model)
    return replace(status, view=status.view or before.view, learning=learning)


def _as_fault(view: LiveView, reason: HoldReason, detail: str) -> LiveView:
    """Return the last view as a fault: the line is held or its lease has expired, and it is not read back."""
    record = replace(view.record, gate_state=GateState.FAULT, hold_reason=reason)
    return replace(view, record=record, is_armed=False, armed_by=None, detail=detail)


def cause_of(status: int) -> str:
    """Return how a process ended: by which signal or with which status."""
    return f"signal {-status}" if status < 0 else f"status {status}"
