"""The engine's process: one session's engine, built as `service.engine_adapter` builds it, and told of to the service.

What leaves for disk stays in the engine's own queues until the service's writer has taken it, so that a writer that
hangs, and a service that is stopped, hold the beam as if they were in this process. A service that is gone is heard of
at once: the line is held, the session ends, and so does this process.
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
from engine.errors import CommandRefusedError
from engine.frames import ColorImage, frozen
from engine.live import LiveView, LoopStatus
from engine.model import MotionModel
from engine.permits import HoldReason
from engine.transition_journal import BorrowedJournal
from service import schemas
from service.engine_adapter import EngineAdapter, LoopEngine
from service.engine_process.crossing import CrossingClosedError, Speech, Whisper
from service.engine_process.messages import (
    Answer,
    AskDevices,
    AskRegistered,
    Beat,
    Farewell,
    Fault,
    News,
    Open,
    Opened,
    Order,
    Prepare,
    Presence,
    Ready,
    Shown,
    Standing,
    Stop,
    Told,
    portable,
)
from service.engine_process.page import Page
from service.engine_process.parting import wake_without_the_service
from service.private_log import install_private_log
from service.unhurried_log import UnhurriedHandler

logger = logging.getLogger(__name__)

PULSE_S = 0.05
"""Told so often at least: what happens between two frames, and that this process lives."""
SWITCH_INTERVAL_S = 0.001
NO_PICTURE: ColorImage = frozen(np.empty((0, 0, 3), np.uint8))
SERVICE_GONE = (HoldReason.SERVICE_SILENT, "the service's process has ended")
FAILED = (HoldReason.ENGINE_FAILED, "the engine's process failed")
T = TypeVar("T")


class Departing(Generic[T]):
    """One of the engine's queues: sent ahead, and emptied only as far as the service's writer has taken from it."""

    def __init__(self, source: Callable[[], "queue.Queue[T]"]) -> None:
        self._source = source
        self._lock = threading.Lock()
        self._sent = self._taken = 0

    def unsent(self) -> tuple[T, ...]:
        """Return what was not sent yet, and count it as sent."""
        with self._lock:
            waiting = self._source()
            with waiting.mutex:
                found = tuple(itertools.islice(waiting.queue, self._sent - self._taken, None))
            self._sent += len(found)
        return found

    def taken(self, count: int) -> None:
        """Hear how many the writer has taken in all."""
        with self._lock:
            for _ in range(min(count, self._sent) - self._taken):
                self._source().get_nowait()
                self._taken += 1

    def let_go(self) -> None:
        """Forget what was sent: nothing is decided any more that it could hold."""
        self.taken(self._sent)


class Asked(Future[None]):
    """An order's answer; whether it is still wanted is looked up on the page at the moment it is carried out."""

    def __init__(self, page: Page, slot: int | None) -> None:
        super().__init__()
        self._page, self._slot = page, slot

    def set_running_or_notify_cancel(self) -> bool:
        """Whether to carry it out."""
        if self._slot is not None and self._page.is_given_up(self._slot):
            self.cancel()
        return super().set_running_or_notify_cancel()


class Teller:
    """Tells the service everything new, in a thread of its own; a service that does not listen is waited for here."""

    def __init__(self, engine: LoopEngine, speech: Speech, page: Page) -> None:
        self._engine, self._speech, self._page = engine, speech, page
        self.samples = Departing(lambda: engine.samples)
        self.transitions = Departing(lambda: engine.transitions)
        self.notices = Departing(lambda: engine.notices)
        self._answers: deque[Answer] = deque()
        self._news = threading.Event()
        self._view: LiveView | None = None
        self._color: ColorImage | None = None
        self._pictures = 0
        self._model: MotionModel | None = None
        engine.on_turn(self._news.set)

    def answer(self, number: int, error: BaseException | None) -> None:
        """Leave an answer to be told, after what it is about; never waits: the engine's own thread calls this."""
        self._answers.append(Answer(number=number, error=None if error is None else portable(error)))
        self._news.set()

    def tell(self) -> None:
        """Tell until the engine is over, then all the rest; raise CrossingClosedError when the service is gone."""
        while True:
            self._news.wait(PULSE_S)
            self._news.clear()
            status = self._engine.status  # read before the rest: what comes last is still told before the end is
            if status.is_over:
                break
            self._speech.send(self._all_news(status))
        while (rest := self._all_news(LoopStatus.RUNNING)).samples or rest.transitions or rest.notices:
            self._speech.send(rest)
            for departing in (self.samples, self.transitions, self.notices):
                departing.let_go()  # what found its queue full comes after
        self._speech.send(self._all_news(status))

    def say_farewell(self, newest_told: int, evidence: dict[str, object]) -> None:
        """Tell what is only known at the very end."""
        self._speech.send(self._all_news(self._engine.status))
        self._speech.send(Farewell(newest_told=newest_told, evidence=evidence))

    def _all_news(self, status: LoopStatus) -> News:
        engine = self._engine
        answers = tuple(self._answers.popleft() for _ in range(len(self._answers)))  # first: the rest is then as new
        transitions, notices, samples = self.transitions.unsent(), self.notices.unsent(), self.samples.unsent()
        view, model = self._new_view(), self._new_model()
        return News(
            samples=samples,
            transitions=transitions,
            notices=notices,
            view=None if view is None else replace(view, color=NO_PICTURE),
            shown=None if view is None else self._show(view),
            model=model,
            standing=Standing(
                status=status, error=engine.error, has_reference=engine.has_reference, likeness=engine.likeness
            ),
            answers=answers,
        )

    def _new_view(self) -> LiveView | None:
        before, self._view = self._view, self._engine.latest
        return None if self._view is before else self._view

    def _new_model(self) -> MotionModel | None:
        before, self._model = self._model, self._engine.model
        return None if self._model is before else self._model

    def _show(self, view: LiveView) -> Shown | None:
        if view.color is self._color:
            return None
        self._color = view.color
        self._pictures += 1
        if not self._page.show(self._pictures, view.color):
            return None
        frame_index = view.record.measurement.frame_index
        return Shown(number=self._pictures, frame_index=frame_index, shape=view.color.shape)


class EngineServer:
    """Serves one session's engine until it is over, or nobody asks any more; no way out of it leaves a line on."""

    def __init__(
        self, engine: LoopEngine, journal: BorrowedJournal | None, *, speech: Speech, whisper: Whisper, page: Page
    ) -> None:
        self._engine, self._journal = engine, journal
        self._speech, self._whisper, self._page = speech, whisper, page
        self._teller = Teller(engine, speech, page)
        self._is_over = False
        self._ending = SERVICE_GONE

    def serve(self, asked_ns: int) -> None:
        """Say that the session has begun, and serve it; returns when this process may end."""
        try:
            self._engine.note_service(asked_ns)
            self._speech.send(Opened())
            for work, name in ((self._tell, "tidegate-teller"), (self._hear_orders, "tidegate-orders")):
                threading.Thread(target=self._lasting, args=(work,), name=name, daemon=True).start()
            self._until_hung_up(lambda: self._hear(self._whisper.receive()))
        finally:
            if not self._is_over:
                self._end_alone(*self._ending)
        if self._ending is FAILED:
            sys.exit(1)

    def _until_hung_up(self, work: Callable[[], None]) -> None:
        """Work again and again; a bug is an end like any other, and told apart in the log and the journal alone."""
        try:
            while True:
                work()
        except CrossingClosedError:
            return
        except Exception:
            self._ending = FAILED
            logger.exception("the engine's process failed")

    def _lasting(self, work: Callable[[], None]) -> None:
        """Do the work of a thread without which this process must not go on."""
        try:
            self._until_hung_up(work)
        finally:
            self._whisper.close()  # wakes the thread that hears

    def _end_alone(self, reason: HoldReason, why: str) -> None:
        """Hold first: nobody could any more. What is left to write is written, for the next start to find."""
        self._engine.report_fault(reason, why)
        self._engine.hold_line(reason)
        self._speech.close()  # what the teller would say now is that the session came to its end
        logger.critical("%s: the beam is held, and the session ends", why)
        self._engine.stop()
        if self._journal is not None:
            self._journal.close()
        self._engine.evidence()

    def _tell(self) -> None:
        self._teller.tell()
        evidence = self._engine.evidence()
        newest_told = 0 if self._journal is None else self._journal.newest_told
        self._is_over = True  # before the farewell: the service hangs up when it has heard that
        self._teller.say_farewell(newest_told, evidence)
        raise CrossingClosedError

    def _hear_orders(self) -> None:
        """Take what is too large to be whispered."""
        self._hear(self._speech.receive())

    def _hear(self, message: object) -> None:
        match message:
            case Beat():
                self._engine.note_service(message.alive_ns)
                self._teller.samples.taken(message.samples)
                self._teller.transitions.taken(message.transitions)
                self._teller.notices.taken(message.notices)
                if self._journal is not None:
                    self._journal.confirm(message.confirmed)
            case Order():
                self._obey(message)
            case Presence():
                self._engine.note_presence(message.operator)
            case Fault():
                self._engine.report_fault(message.reason, message.detail)
            case Stop():  # beside this thread, which has to go on hearing a hold
                threading.Thread(target=self._engine.stop, name="tidegate-stopping", daemon=True).start()
            case _:
                msg = f"the service says what this process does not know: {type(message).__name__}"
                raise TypeError(msg)

    def _obey(self, order: Order) -> None:
        asked = Asked(self._page, order.slot)
        try:
            answer = self._engine.submit(order.command, answer=asked, submitted_ns=order.submitted_ns)
        except CommandRefusedError as error:
            self._teller.answer(order.number, error)
            return
        answer.add_done_callback(lambda done: self._teller.answer(order.number, _outcome(done)))


def _outcome(done: Future[None]) -> BaseException | None:
    return CommandRefusedError("given up before it was carried out") if done.cancelled() else done.exception()


def _asked_to_open(adapter: EngineAdapter, speech: Speech) -> Open:
    """Answer what is asked about cameras until a session is to begin."""
    while not isinstance(asked := speech.receive(), Open):
        speech.send(_told(adapter, asked))
    wake_without_the_service()
    return asked


def _told(adapter: EngineAdapter, asked: AskDevices | AskRegistered) -> Told:
    try:
        return Told(answer=_answered(adapter, asked))
    except Exception as error:
        refusal = portable(error)
        if refusal is not error:
            logger.exception("a camera could not be asked about itself")
        return Told(error=refusal)


def _answered(adapter: EngineAdapter, asked: AskDevices | AskRegistered) -> schemas.DeviceList | Calibration:
    match asked:
        case AskDevices():
            return adapter.devices()
        case AskRegistered():
            return adapter.registered_calibration(asked.uri)


def serve_one_session(speech: Speech, whisper: Whisper, page: Page) -> None:
    """Be an engine's process: prepare, wait for a session, run it, end."""
    prepare: Prepare = speech.receive()
    settings = prepare.settings
    install_private_log(settings.log_level, settings.log_format, handler=UnhurriedHandler())
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    adapter = EngineAdapter(settings, measuring=prepare.measuring)
    gc.collect()
    gc.freeze()
    speech.send(Ready())
    asked = _asked_to_open(adapter, speech)
    install_private_log(
        settings.log_level, settings.log_format, session_id=asked.plan.session_id, handler=UnhurriedHandler()
    )
    try:
        journal = BorrowedJournal(whisper.receive_file()) if asked.has_journal else None
        engine = adapter.open(replace(asked.plan, journal=journal))
    except Exception as error:
        refusal = portable(error)
        if refusal is not error:
            logger.exception("a session could not be opened")
        speech.send(Opened(error=refusal))
        return
    EngineServer(engine, journal, speech=speech, whisper=whisper, page=page).serve(asked.sent_ns)


def ends_of(files: list[int]) -> tuple[Speech, Whisper, Page]:
    """Make the ends of what this process was started with."""
    speech, whisper, page = files
    return Speech(socket.socket(fileno=speech)), Whisper(socket.socket(fileno=whisper)), Page(page)
