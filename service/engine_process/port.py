"""Makes engines in processes of their own: what `tidegate serve` runs sessions with.

A camera belongs to one process at a time, so the one that would open it is asked about it: the one that stands by.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial

from engine.calibration import Calibration
from engine.capture.openni import runtime_installed
from engine.errors import CommandRefusedError, TidegateError
from engine.pipeline import PipelineSettings
from service import schemas
from service.engine_process.child import Child
from service.engine_process.crossing import CrossingClosedError
from service.engine_process.messages import AskDevices, AskRegistered, Prepare, Told
from service.engine_process.remote import RemoteEngine, begin_session, cause_of
from service.engine_process.standby import StandBy
from service.errors import EngineProcessError
from service.ports import RunningEngine, SessionPlan
from service.settings import Settings

ASK_S = 10.0
"""A driver that takes longer hangs: its process is ended, and the next one asked."""
GONE_S = 5.0
OPEN_TURN_S = 30.0
LIST_TURN_S = 1.0
LISTED_BEFORE = "a session has the cameras, or somebody asks for them: this is what was there before"
NOT_LOOKED = "a session has the cameras, or somebody asks for them: they were not looked for before"


class TurnError(EngineProcessError):
    """Others ask, or begin a session."""


class ProcessEngine:
    """See the module."""

    def __init__(self, settings: Settings, *, measuring: PipelineSettings | None = None) -> None:
        self.is_simulated_beam = settings.is_simulated_beam
        self._standby = StandBy(Prepare(settings=settings, measuring=measuring))
        # A question and a session's beginning do not mix: both have the one process that stands by.
        self._lock = threading.Lock()
        self._newest: RemoteEngine | None = None
        self._begun = 0
        self._listed: schemas.DeviceList | None = None
        self._lost = 0

    @property
    def trouble(self) -> str | None:
        """Why no session could begin at once."""
        return self._standby.trouble

    @property
    def processes_lost(self) -> int:
        """How many ended by themselves, or had to be ended."""
        return self._lost + self._standby.lost

    def open(self, plan: SessionPlan) -> RunningEngine:
        """Start a session's engine, disarmed, in the process that stands by; raise what it raises."""
        with self._turn(OPEN_TURN_S):
            if isinstance(plan.source, schemas.DeviceSource):
                with suppress(TidegateError):  # a list is for people: the camera opens, or says why not
                    self._remember(self._ask(AskDevices()))
            self._await_the_last()
            self._begun += 1
            self._newest = begin_session(self._standby.take(), plan, on_gone=partial(self._gone, self._begun))
            return self._newest

    def registered_calibration(self, uri: str | None) -> Calibration:
        """Return the nominal calibration of a camera that registers depth to colour itself; refuse any other."""
        with self._turn(OPEN_TURN_S):
            if self._is_running:
                msg = "a session runs: its camera is not asked about itself"
                raise CommandRefusedError(msg)
            told = self._ask(AskRegistered(uri=uri))
        assert isinstance(told.answer, Calibration)
        return told.answer

    def devices(self) -> schemas.DeviceList:
        """List the cameras that could be used; those of before while a session runs, begins, or somebody asks."""
        if self._is_running:
            return self._listed_before
        try:
            with self._turn(LIST_TURN_S):
                return self._listed_before if self._is_running else self._remember(self._ask(AskDevices()))
        except TurnError:
            return self._listed_before

    @property
    def _is_running(self) -> bool:
        return self._newest is not None and not self._newest.status.is_over

    @property
    def _listed_before(self) -> schemas.DeviceList:
        if self._listed is None:
            return schemas.DeviceList(is_runtime_available=runtime_installed(), detail=NOT_LOOKED, items=[])
        return self._listed.model_copy(update={"detail": LISTED_BEFORE})

    def _remember(self, told: Told) -> schemas.DeviceList:
        assert isinstance(told.answer, schemas.DeviceList)
        self._listed = told.answer
        return self._listed

    @contextmanager
    def _turn(self, seconds: float) -> Iterator[None]:
        """Be the only one to ask or to begin; raise TurnError where others are at it for so long."""
        if not self._lock.acquire(timeout=seconds):
            msg = "a camera is being asked about itself, or a session begins: try again in a moment"
            raise TurnError(msg)
        try:
            yield
        finally:
            self._lock.release()

    def _await_the_last(self) -> None:
        """Wait until the process before has ended and left its camera."""
        if self._newest is not None:
            self._newest.await_gone(GONE_S)

    def _ask(self, question: AskDevices | AskRegistered) -> Told:
        self._await_the_last()
        child = self._standby.take()
        try:
            return self._told_by(child, question)
        finally:
            self._standby.give_back(child)

    def _told_by(self, child: Child, question: AskDevices | AskRegistered) -> Told:
        """Ask one that stood by; raise what it raises, and end it where it does not answer."""
        try:
            child.speech.patience(ASK_S)
            child.speech.send(question)
            told: Told = child.speech.receive()
            child.speech.patience(None)
        except CrossingClosedError as error:
            child.kill()
            msg = f"the engine's process did not answer about cameras, and was ended ({cause_of(child.bury())})"
            raise EngineProcessError(msg) from error
        if told.error is not None:
            raise told.error
        return told

    def _gone(self, number: int, *, is_lost: bool) -> None:
        self._lost += is_lost
        if number == self._begun:  # else one runs, and none is started beside it
            self._standby.want()

    def close(self) -> None:
        """End the process that stands by."""
        self._standby.close()
