"""Runs each session's engine in a process of its own, as `tidegate serve` does.

A camera belongs to one process at a time, so camera requests go to the standby process, which would open it.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial

from engine.calibration import Calibration
from engine.capture.drivers import is_any_installed, kinds
from engine.core.errors import CommandRefusedError, TidegateError
from engine.motion import PipelineSettings
from service.core.errors import EngineProcessError
from service.core.schemas import sessions
from service.core.settings.settings import Settings
from service.engine_host.process.channels import ChannelClosedError
from service.engine_host.process.messages import (
    CameraAnswer,
    ChildProcess,
    ListDevices,
    Prepare,
    ReadRegistration,
    Ready,
    start_child,
)
from service.engine_host.process.remote_engine import RemoteEngine, begin_session, cause_of
from service.engine_host.protocols import RunningEngine, SessionPlan

logger = logging.getLogger(__name__)

START_S = 30.0
LOOK_S = 0.5
AGAIN_S = 2.0
NONE_YET = "the engine process is being started"
ASK_S = 10.0
"""A driver that takes longer hangs: its process is killed, and the next request goes to the next process [s]."""
END_WAIT_S = 5.0
OPEN_TURN_S = 30.0
LIST_TURN_S = 1.0
LISTED_EARLIER = "a session or another request is using the cameras: this is the earlier list"
NEVER_LISTED = "a session or another request is using the cameras, and they were not listed before"


# The standby process: started and imported in advance, so that a session starts without delay.
#
# One is started at the service's start and after each session, never beside one: its imports would take a processor
# core from the frames being measured.
class StandbyProcess:
    """Keeps one process on standby while one is wanted."""

    def __init__(self, prepare: Prepare) -> None:
        self._prepare = prepare
        self._change = threading.Condition()
        self._is_wanted, self._is_closed = True, False
        self._ready: ChildProcess | None = None
        self._starting: ChildProcess | None = None
        self._trouble: str | None = NONE_YET
        self.lost = 0
        self._thread = threading.Thread(target=self._run, name="tidegate-engine-standby", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str | None:
        """Why there is no standby process although one is wanted; None otherwise."""
        with self._change:
            return None if self._ready is not None or not self._is_wanted else self._trouble or NONE_YET

    def want(self) -> None:
        """Start one, and replace it when it dies, until one is taken."""
        with self._change:
            self._is_wanted = True
            self._change.notify_all()

    def take(self) -> ChildProcess:
        """Take the standby process, or wait for the next; none is started until one is wanted again.

        Raises
        ------
        EngineProcessError
            None is ready after 30 s, or the service is closing.
        """
        with self._change:
            self._is_wanted = True
            self._change.notify_all()
            found = self._change.wait_for(lambda: self._ready is not None or self._is_closed, START_S)
            child, self._ready = self._ready, None
            if not found or child is None:
                msg = f"no session can begin: {self._trouble or NONE_YET}"
                raise EngineProcessError(msg)
            self._is_wanted = False
        return child

    def give_back(self, child: ChildProcess) -> None:
        """Put a process back after a camera request; start another where it died."""
        with self._change:
            self._is_wanted = True
            if not child.is_alive:
                self.lost += 1
                self._change.notify_all()
                return
            is_kept = self._adopt(child)
        if not is_kept:
            _reap(child)

    def close(self) -> None:
        """End the standby process; the kernel ends one that is taken, when this object's thread ends."""
        with self._change:
            self._is_closed = True
            child, self._ready = self._ready, None
            if self._starting is not None:
                self._starting.kill()
            self._change.notify_all()
        if child is not None:
            child.reap()
            child.page.close()
        self._thread.join(START_S)

    def _run(self) -> None:
        while not self._is_closed:
            with self._change:
                self._change.wait_for(lambda: self._is_closed or self._is_due, LOOK_S)
                self._reap_dead()
                is_due = self._is_due and not self._is_closed
            if is_due and not self._start():
                with self._change:
                    self._change.wait_for(lambda: self._is_closed, AGAIN_S)

    @property
    def _is_due(self) -> bool:
        return self._is_wanted and self._ready is None

    def _reap_dead(self) -> None:
        """Reap a standby process that died."""
        if self._ready is not None and not self._ready.is_alive:
            child, self._ready = self._ready, None
            self.lost += 1
            logger.warning("the standby engine process died (status %s)", child.reap())

    def _start(self) -> bool:
        """Start one; return False where that failed."""
        try:
            child = self._starting = start_child()
        except OSError as error:
            self._trouble = f"the engine's process does not start: {error.strerror}"
            logger.error("%s", self._trouble)  # noqa: TRY400 - the text is complete
            return False
        try:
            child.bulk.set_timeout(START_S)
            child.bulk.send(self._prepare)
            assert isinstance(child.bulk.receive(), Ready)
            child.bulk.set_timeout(None)
        except ChannelClosedError:
            child.kill()
            status = child.reap()
            self._starting = None
            self._trouble = f"the engine's process ended before it was ready (status {status})"
            if not self._is_closed:
                logger.error("%s", self._trouble)  # noqa: TRY400 - the text is complete
            return False
        self._starting = None
        with self._change:
            is_kept = self._adopt(child)
        if not is_kept:
            _reap(child)
        return True

    def _adopt(self, child: ChildProcess) -> bool:
        """Keep it on standby unless there is one, or this is closed; called with the lock held."""
        is_kept = not self._is_closed and self._ready is None
        if is_kept:
            self._ready, self._trouble = child, None
        self._change.notify_all()
        return is_kept


def _reap(child: ChildProcess) -> None:
    with contextlib.suppress(OSError):
        child.reap()


class TurnError(EngineProcessError):
    """Another camera request, or the start of a session, is in progress."""

    code = EngineProcessError.code


class ProcessEngine:
    """The service's :class:`~service.engine_host.protocols.EnginePort`: one process a session, one on standby."""

    def __init__(self, settings: Settings, *, measuring: PipelineSettings | None = None) -> None:
        self.is_simulated_beam = settings.is_simulated_beam
        self._standby = StandbyProcess(Prepare(settings=settings, measuring=measuring))
        # A camera request and the start of a session exclude each other: both use the standby process.
        self._lock = threading.Lock()
        self._newest: RemoteEngine | None = None
        self._begun = 0
        self._listed: sessions.DeviceList | None = None
        self._lost = 0
        self._server_turned_ns = time.monotonic_ns()

    @property
    def trouble(self) -> str | None:
        """Why no session could start now; None where one could."""
        return self._standby.trouble

    @property
    def processes_lost(self) -> int:
        """How many processes died or were killed."""
        return self._lost + self._standby.lost

    def open(self, plan: SessionPlan) -> RunningEngine:
        """Start a session's engine, disarmed, in the standby process; raise what it raises."""
        with self._turn(OPEN_TURN_S):
            if isinstance(plan.source, sessions.DeviceSource):
                with suppress(TidegateError):  # the list is only for display: opening the camera reports its own error
                    self._remember(self._ask(ListDevices()))
            self._await_previous()
            self._begun += 1
            self._newest = begin_session(
                self._standby.take(),
                plan,
                on_end=partial(self._process_ended, self._begun),
                server_turned_ns=lambda: self._server_turned_ns,
            )
            return self._newest

    def note_server_turn(self, turned_ns: int) -> None:
        """Note a turn of the web server's event loop; heartbeats carry the newest, so a blocked loop is silence."""
        self._server_turned_ns = turned_ns

    def built_in_calibration(self, uri: str | None) -> Calibration:
        """Return the calibration that a camera brings itself; refuse one that has none."""
        with self._turn(OPEN_TURN_S):
            if self._is_running:
                msg = "a session is running: its camera cannot be queried"
                raise CommandRefusedError(msg)
            answer = self._ask(ReadRegistration(uri=uri))
        assert isinstance(answer.answer, Calibration)
        return answer.answer

    def devices(self) -> sessions.DeviceList:
        """List the cameras; the earlier list while a session or another camera request has them."""
        if self._is_running:
            return self._earlier_list
        try:
            with self._turn(LIST_TURN_S):
                return self._earlier_list if self._is_running else self._remember(self._ask(ListDevices()))
        except TurnError:
            return self._earlier_list

    @property
    def _is_running(self) -> bool:
        return self._newest is not None and not self._newest.status.is_over

    @property
    def _earlier_list(self) -> sessions.DeviceList:
        if self._listed is None:
            return sessions.DeviceList(
                is_runtime_available=is_any_installed(),
                detail=NEVER_LISTED,
                kinds=sessions.device_kinds(kinds()),
                items=[],
            )
        return self._listed.model_copy(update={"detail": LISTED_EARLIER})

    def _remember(self, answer: CameraAnswer) -> sessions.DeviceList:
        assert isinstance(answer.answer, sessions.DeviceList)
        self._listed = answer.answer
        return self._listed

    @contextmanager
    def _turn(self, seconds: float) -> Iterator[None]:
        """Hold the lock of camera requests and session starts; raise TurnError after so long [s]."""
        if not self._lock.acquire(timeout=seconds):
            msg = "another camera request or the start of a session is in progress: try again in a moment"
            raise TurnError(msg)
        try:
            yield
        finally:
            self._lock.release()

    def _await_previous(self) -> None:
        """Wait until the previous session's process has ended and released its camera."""
        if self._newest is not None:
            self._newest.await_end(END_WAIT_S)

    def _ask(self, question: ListDevices | ReadRegistration) -> CameraAnswer:
        self._await_previous()
        child = self._standby.take()
        try:
            return self._ask_child(child, question)
        finally:
            self._standby.give_back(child)

    def _ask_child(self, child: ChildProcess, question: ListDevices | ReadRegistration) -> CameraAnswer:
        """Send a standby process a request; raise what it answers, and kill it where it does not answer."""
        try:
            child.bulk.set_timeout(ASK_S)
            child.bulk.send(question)
            answer: CameraAnswer = child.bulk.receive()
            child.bulk.set_timeout(None)
        except ChannelClosedError as error:
            child.kill()
            msg = f"the engine process did not answer about cameras and was killed ({cause_of(child.reap())})"
            raise EngineProcessError(msg) from error
        if answer.error is not None:
            raise answer.error
        return answer

    def _process_ended(self, number: int, *, is_lost: bool) -> None:
        self._lost += is_lost
        if number == self._begun:  # else a newer session runs, and no process is started beside it
            self._standby.want()

    def close(self) -> None:
        """End the standby process."""
        self._standby.close()
