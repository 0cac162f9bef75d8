"""Runs each session's engine in a process of its own, as `tidegate serve` does.

A camera belongs to one process at a time, so camera requests go to the standby process, which would open it.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial

from engine.calibration.camera_calibration import Calibration
from engine.capture.drivers import is_any_installed
from engine.core.errors import CommandRefusedError, TidegateError
from engine.motion.settings import PipelineSettings
from service.core.errors import EngineProcessError
from service.core.schemas import sessions
from service.core.settings.settings import Settings
from service.engine_host.process.channels import ChannelClosedError
from service.engine_host.process.child_process import ChildProcess
from service.engine_host.process.messages import CameraAnswer, ListDevices, Prepare, ReadRegistration
from service.engine_host.process.remote_engine import RemoteEngine, begin_session, cause_of
from service.engine_host.process.standby import StandbyProcess
from service.engine_host.roles import RunningEngine, SessionPlan

ASK_S = 10.0
"""A driver that takes longer hangs: its process is killed, and the next request goes to the next process [s]."""
END_WAIT_S = 5.0
OPEN_TURN_S = 30.0
LIST_TURN_S = 1.0
LISTED_EARLIER = "a session or another request is using the cameras: this is the earlier list"
NEVER_LISTED = "a session or another request is using the cameras, and they were not listed before"


class TurnError(EngineProcessError):
    """Another camera request, or the start of a session, is in progress."""


class ProcessEngine:
    """The service's :class:`~service.engine_host.roles.EnginePort`: one process a session, one on standby."""

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

    def registered_calibration(self, uri: str | None) -> Calibration:
        """Return the nominal calibration of a camera that registers depth to colour itself; refuse any other."""
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
            return sessions.DeviceList(is_runtime_available=is_any_installed(), detail=NEVER_LISTED, items=[])
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
