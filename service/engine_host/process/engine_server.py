"""The engine process's side: run one session's engine, execute the service's commands, send it updates.

Records for the disk stay in the engine's own queues until the service's writer has taken them: a writer that hangs, or
a stopped service, holds the beam just as in a single process. When the service ends, its channels close: this process
holds the line at once, ends the session, and ends.
"""

import gc
import itertools
import logging
import queue
import socket
import sys
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np

from engine.calibration import Calibration
from engine.control import ClientJournal, EngineStatus, LiveView, LoopStatus
from engine.core.errors import CommandRefusedError
from engine.core.frames import ColorImage, frozen
from engine.core.gate_state import HoldReason
from engine.core.learning_status import LearningStatus
from engine.core.motion_model import MotionModel
from engine.motion import ProcessTrainer
from service.core.logging.nonblocking import NonblockingHandler
from service.core.logging.redaction import install_private_log
from service.core.schemas import sessions
from service.engine_host.local_engine import LocalEngine, LoopEngine
from service.engine_host.process.channels import (
    BulkChannel,
    ChannelClosedError,
    ControlChannel,
    SharedPage,
    wake_without_the_service,
)
from service.engine_host.process.messages import (
    CameraAnswer,
    CommandMessage,
    CommandResult,
    EngineUpdate,
    Fault,
    FinalReport,
    Heartbeat,
    ListDevices,
    Open,
    Opened,
    Prepare,
    Presence,
    ReadRegistration,
    Ready,
    Stop,
    portable,
)

logger = logging.getLogger(__name__)

UPDATE_INTERVAL_S = 0.05
"""Longest time between two updates [s]: they also show the service that this process runs."""
SWITCH_INTERVAL_S = 0.001
NO_PICTURE: ColorImage = frozen(np.empty((0, 0, 3), np.uint8))
SERVICE_GONE = (HoldReason.SERVICE_SILENT, "the service's process has ended")
FAILED = (HoldReason.ENGINE_FAILED, "the engine's process failed")
T = TypeVar("T")


class OutgoingQueue(Generic[T]):
    """One of the engine's queues: items are sent at once, and removed only once the service's writer has taken them."""

    def __init__(self, source: Callable[[], "queue.Queue[T]"]) -> None:
        self._source = source
        self._lock = threading.Lock()
        self._sent = self._taken = 0

    def unsent(self) -> tuple[T, ...]:
        """Return the items that were not sent yet, and count them as sent."""
        with self._lock:
            waiting = self._source()
            with waiting.mutex:
                found = tuple(itertools.islice(waiting.queue, self._sent - self._taken, None))
            self._sent += len(found)
        return found

    def acknowledge(self, count: int) -> None:
        """Remove what the writer has taken; ``count`` is its total. A smaller total than before changes nothing."""
        with self._lock:
            for _ in range(min(count, self._sent) - self._taken):
                self._source().get_nowait()
                self._taken += 1

    def discard_sent(self) -> None:
        """Remove everything that was sent: the engine is over, so a full queue need not hold the beam any more."""
        self.acknowledge(self._sent)


class CommandFuture(Future[None]):
    """The future of a command; its cancellation is read from the shared page at the moment of execution."""

    def __init__(self, page: SharedPage, slot: int | None) -> None:
        super().__init__()
        self._page, self._slot = page, slot

    def set_running_or_notify_cancel(self) -> bool:
        """Return False, and cancel, where the service has cancelled the command."""
        if self._slot is not None and self._page.is_cancelled(self._slot):
            self.cancel()
        return super().set_running_or_notify_cancel()


class UpdateSender:
    """Sends the service everything new, in a thread of its own, which alone waits for a service that does not read."""

    def __init__(self, engine: LoopEngine, bulk: BulkChannel, page: SharedPage) -> None:
        self._engine, self._bulk, self._page = engine, bulk, page
        self.samples = OutgoingQueue(lambda: engine.samples)
        self.transitions = OutgoingQueue(lambda: engine.transitions)
        self.notices = OutgoingQueue(lambda: engine.notices)
        self._answers: deque[CommandResult] = deque()
        self._has_news = threading.Event()
        self._view: LiveView | None = None
        self._color: ColorImage | None = None
        self._model: MotionModel | None = None
        engine.on_turn(self._has_news.set)

    def answer(self, number: int, error: BaseException | None) -> None:
        """Queue a command's result for the next update; never waits, because the engine's thread calls it."""
        self._answers.append(CommandResult(number=number, error=None if error is None else portable(error)))
        self._has_news.set()

    def run(self) -> None:
        """Send updates until the engine is over and its queues are empty; raise ChannelClosedError without service."""
        while True:
            self._has_news.wait(UPDATE_INTERVAL_S)
            self._has_news.clear()
            run_state = self._engine.status.run_state  # read first: what comes last is sent before the end
            if run_state.is_over:
                break
            self._bulk.send(self._next_update(run_state))
        while (rest := self._next_update(LoopStatus.RUNNING)).samples or rest.transitions or rest.notices:
            self._bulk.send(rest)
            for outgoing in (self.samples, self.transitions, self.notices):
                outgoing.discard_sent()  # makes room for what found its queue full
        self._bulk.send(self._next_update(run_state))

    def send_final_report(self, newest_committed: int, evidence: dict[str, object]) -> None:
        """Send the last update and the final report."""
        self._bulk.send(self._next_update(self._engine.status.run_state))
        self._bulk.send(FinalReport(newest_committed=newest_committed, evidence=evidence))

    def _next_update(self, run_state: LoopStatus) -> EngineUpdate:
        engine = self._engine
        # Read first: all else is then at least as new as what the results are about.
        answers = tuple(self._answers.popleft() for _ in range(len(self._answers)))
        transitions, notices, samples = self.transitions.unsent(), self.notices.unsent(), self.samples.unsent()
        current = replace(engine.status, run_state=run_state)
        view, learning = self._new_view(current), self._new_learning(current)
        if view is not None:
            self._show(view)
        return EngineUpdate(
            samples=samples,
            transitions=transitions,
            notices=notices,
            status=replace(current, view=None if view is None else replace(view, color=NO_PICTURE), learning=learning),
            answers=answers,
        )

    def _new_view(self, status: EngineStatus) -> LiveView | None:
        before, self._view = self._view, status.view
        return None if self._view is before else self._view

    def _new_learning(self, status: EngineStatus) -> LearningStatus:
        """Return what is known of model and reference, without the model where it was sent already."""
        before, self._model = self._model, status.learning.model
        return replace(status.learning, model=None) if self._model is before else status.learning

    def _show(self, view: LiveView) -> None:
        """Write the view's picture to the shared page, unless it is there already."""
        if view.color is self._color:
            return
        self._color = view.color
        self._page.write_picture(view.record.measurement.frame_index, view.color)


class EngineServer:
    """Runs one session's engine until it or the service ends; every exit holds the line."""

    def __init__(
        self,
        engine: LoopEngine,
        journal: ClientJournal | None,
        *,
        bulk: BulkChannel,
        control: ControlChannel,
        page: SharedPage,
    ) -> None:
        self._engine, self._journal = engine, journal
        self._bulk, self._control, self._page = bulk, control, page
        self._sender = UpdateSender(engine, bulk, page)
        self._is_over = False
        self._ending = SERVICE_GONE

    def serve(self, asked_ns: int) -> None:
        """Report that the session has started, and serve it; return when this process may end."""
        try:
            self._engine.note_service(asked_ns)
            self._bulk.send(Opened())
            for work, name in ((self._send_updates, "tidegate-updates"), (self._receive_large, "tidegate-orders")):
                threading.Thread(target=self._run_vital, args=(work,), name=name, daemon=True).start()
            self._until_closed(lambda: self._handle(self._control.receive()))
        finally:
            if not self._is_over:
                self._end_session(*self._ending)
        if self._ending is FAILED:
            sys.exit(1)

    def _until_closed(self, work: Callable[[], None]) -> None:
        """Repeat ``work`` until the channel closes; a bug ends the session likewise, and is logged."""
        try:
            while True:
                work()
        except ChannelClosedError:
            return
        except Exception:
            self._ending = FAILED
            logger.exception("the engine's process failed")

    def _run_vital(self, work: Callable[[], None]) -> None:
        """Repeat the work of a vital thread; when it ends, close the control channel, which ends the session."""
        try:
            self._until_closed(work)
        finally:
            self._control.close()  # wakes the thread that receives on it

    def _end_session(self, reason: HoldReason, why: str) -> None:
        """Hold the line, end the session without a service, and complete the journal for the next start."""
        self._engine.report_fault(reason, why)
        self._engine.hold_line(reason)
        self._bulk.close()  # else the sender would report a regular end of the session
        logger.critical("%s: the beam is held, and the session ends", why)
        self._engine.stop()
        if self._journal is not None:
            self._journal.close()
        self._engine.evidence()

    def _send_updates(self) -> None:
        self._sender.run()
        evidence = self._engine.evidence()
        newest_committed = 0 if self._journal is None else self._journal.newest_committed
        self._is_over = True  # before the final report, after which the service closes the channels
        self._sender.send_final_report(newest_committed, evidence)
        raise ChannelClosedError

    def _receive_large(self) -> None:
        """Receive a message that is too large for the control channel."""
        self._handle(self._bulk.receive())

    def _handle(self, message: object) -> None:
        match message:
            case Heartbeat():
                self._engine.note_service(message.alive_ns)
                self._sender.samples.acknowledge(message.samples)
                self._sender.transitions.acknowledge(message.transitions)
                self._sender.notices.acknowledge(message.notices)
                if self._journal is not None:
                    self._journal.acknowledge(message.acknowledged)
            case CommandMessage():
                self._submit(message)
            case Presence():
                self._engine.note_presence(message.operator)
            case Fault():
                self._engine.report_fault(message.reason, message.detail)
            case Stop():  # in another thread: this one has to go on receiving, for a hold
                threading.Thread(target=self._engine.stop, name="tidegate-stopping", daemon=True).start()
            case _:
                msg = f"unknown message of the service: {type(message).__name__}"
                raise TypeError(msg)

    def _submit(self, message: CommandMessage) -> None:
        future = CommandFuture(self._page, message.slot)
        try:
            answer = self._engine.submit(message.command, answer=future, submitted_ns=message.submitted_ns)
        except CommandRefusedError as error:
            self._sender.answer(message.number, error)
            return
        answer.add_done_callback(lambda done: self._sender.answer(message.number, _outcome(done)))


def _outcome(done: Future[None]) -> BaseException | None:
    return CommandRefusedError("cancelled before it was executed") if done.cancelled() else done.exception()


def _await_open(adapter: LocalEngine, bulk: BulkChannel) -> Open:
    """Answer camera requests until a session is requested; return that request."""
    while not isinstance(request := bulk.receive(), Open):
        bulk.send(_camera_answer(adapter, request))
    wake_without_the_service()
    return request


def _camera_answer(adapter: LocalEngine, request: ListDevices | ReadRegistration) -> CameraAnswer:
    try:
        return CameraAnswer(answer=_query_camera(adapter, request))
    except Exception as error:
        refusal = portable(error)
        if refusal is not error:
            logger.exception("a camera could not be queried")
        return CameraAnswer(error=refusal)


def _query_camera(adapter: LocalEngine, request: ListDevices | ReadRegistration) -> sessions.DeviceList | Calibration:
    match request:
        case ListDevices():
            return adapter.devices()
        case ReadRegistration():
            return adapter.built_in_calibration(request.uri)


def serve_one_session(bulk: BulkChannel, control: ControlChannel, page: SharedPage) -> None:
    """Run an engine process: prepare, wait for a session, run it, return."""
    prepare: Prepare = bulk.receive()
    settings = prepare.settings
    install_private_log(settings.log_level, settings.log_format, handler=NonblockingHandler(), room=settings.room)
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    adapter = LocalEngine(settings, measuring=prepare.measuring, trainer=ProcessTrainer)
    gc.collect()
    gc.freeze()
    gc.enable()
    bulk.send(Ready())
    adapter.stand_by()
    request = _await_open(adapter, bulk)
    install_private_log(
        settings.log_level,
        settings.log_format,
        session_id=request.plan.session_id,
        handler=NonblockingHandler(),
        room=settings.room,
    )
    try:
        journal = ClientJournal(control.receive_file()) if request.has_journal else None
        engine = adapter.open(replace(request.plan, journal=journal))
    except Exception as error:
        refusal = portable(error)
        if refusal is not error:
            logger.exception("a session could not be opened")
        bulk.send(Opened(error=refusal))
        return
    EngineServer(engine, journal, bulk=bulk, control=control, page=page).serve(request.sent_ns)


def open_channels(files: list[int]) -> tuple[BulkChannel, ControlChannel, SharedPage]:
    """Open this process's ends of the channels and the shared page, from the file numbers of its command line."""
    bulk, control, page = files
    return BulkChannel(socket.socket(fileno=bulk)), ControlChannel(socket.socket(fileno=control)), SharedPage(page)
