"""The roles the service is made of: what a router may ask, and what the engine looks like from here.

Routers know these protocols and the schemas, nothing else; `service.engine_adapter` stands behind the engine's, tests
put fakes there.
"""

import queue
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, Literal, Protocol, TypeVar

from engine.calibration import Calibration
from engine.commands import Command
from engine.frames import ColorImage
from engine.likeness import Likeness
from engine.live import FrameRecord, GateTransition, LiveView, LoopStatus
from engine.model import MotionModel
from engine.notices import LearningNotice
from engine.permits import HoldReason
from engine.transition_journal import TransitionJournal
from service import schemas
from service.access.calling import Calling
from service.audit.export import ExportRequest
from service.audit_schemas import AuditPage, AuditVerification
from service.calibration_schemas import CalibrationDetail, CalibrationPage, UploadedCalibration
from service.conditional import Precondition
from service.gate_schemas import BaselineCorrectionRequest, InterlockList
from service.idempotency import CallersKey
from service.list_filters import (
    ALL_ROWS,
    ALL_SESSIONS,
    ALL_TRANSITIONS,
    AuditFilter,
    SessionFilter,
    TransitionFilter,
)
from service.live_messages import Sample
from service.model_schemas import Model, ModelPage, Spectrum
from service.plan_schemas import Plan, PlanPage, PlanSessionRequest, PreparedSession
from service.problem_schemas import Problem
from service.readiness_schemas import Readiness
from service.window_schemas import Window

CommandName = Literal["arm", "disarm", "reference", "acknowledge", "hold", "release"]
AnswerT = TypeVar("AnswerT")


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionPlan:
    """Everything an engine needs to run a session; ``recording`` is None for a live camera.

    ``model`` is the stored one to begin with, None to learn one.
    """

    session_id: str
    source: schemas.RecordingSource | schemas.DeviceSource
    recording: Path | None
    calibration: Calibration
    window: Window
    regions: schemas.Regions = field(default_factory=schemas.Regions)
    patient_reference: str = ""
    model: MotionModel | None = None
    journal: TransitionJournal | None = None
    model_id: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """The newest colour frame as JPEG."""

    frame_index: int
    jpeg: bytes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LiveFrame:
    """The newest frame as a live message; when it was in our hands, and taken where the camera tells (monotonic)."""

    message: Sample
    received_ns: int
    captured_ns: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept(Generic[AnswerT]):
    """An answer to a creating call; ``is_replay`` when it was given before."""

    answer: AnswerT
    is_replay: bool


class RunningEngine(Protocol):
    """An engine at work on one session. Everything here is safe from any thread and never waits for a frame."""

    @property
    def samples(self) -> "queue.Queue[FrameRecord]":
        """One record a frame; bounded: when nobody takes them, the gate holds."""

    @property
    def transitions(self) -> "queue.Queue[GateTransition]":
        """Every change of the gate; bounded likewise."""

    @property
    def notices(self) -> "queue.Queue[LearningNotice]":
        """What the learning of models has to tell; bounded likewise."""

    @property
    def latest(self) -> LiveView | None:
        """The newest of everything, or None before the first frame."""

    def picture(self) -> tuple[int, ColorImage] | None:
        """Return the newest frame's index and colour picture; None before there is one. A view may come without."""

    @property
    def has_reference(self) -> bool:
        """Whether motion has a zero that somebody may arm with."""

    @property
    def likeness(self) -> Likeness | None:
        """How far the patient is from the stored model it began with; None without one, or not known yet."""

    @property
    def model(self) -> MotionModel | None:
        """The model frames are measured with now."""

    @property
    def status(self) -> LoopStatus:
        """Where the engine's one life stands."""

    @property
    def error(self) -> str | None:
        """Why it failed, for a person."""

    def submit(self, command: Command, *, submitted_ns: int | None = None) -> "Future[None]":
        """Ask; raise CommandRefusedError at once when too much is being asked already.

        ``submitted_ns`` is when it was asked for, host monotonic time; now, if left out.
        """

    def note_presence(self, operator: str) -> None:
        """Hear that a person's page is still looked at; never waits."""

    def report_fault(self, reason: HoldReason, detail: str) -> None:
        """Fault the gate because something around the engine failed; ``reason`` must be one that latches."""

    def stop(self) -> None:
        """Hold the beam, then end; returns when the engine has ended or does not answer."""

    def evidence(self) -> dict[str, object]:
        """Return what the audit keeps of the files written beside the session, such as their hashes; once it is over.

        Waits for them a few seconds at most.
        """


class EnginePort(Protocol):
    """Makes engines; the one way from the service to cameras, gate and beam line."""

    @property
    def is_simulated_beam(self) -> bool:
        """Whether the beam line is a simulation."""

    def open(self, plan: SessionPlan) -> RunningEngine:
        """Start an engine on a session, disarmed; raise a TidegateError when source or window cannot be used."""

    def registered_calibration(self, uri: str | None) -> Calibration:
        """Return the nominal calibration of a camera that registers depth to colour itself; refuse any other."""

    def devices(self) -> schemas.DeviceList:
        """List the cameras that could be used."""

    @property
    def trouble(self) -> str | None:
        """Why no session could begin at once; None where one could."""

    def close(self) -> None:
        """End what waits for a session; no session runs any more."""


class SessionsPort(Protocol):
    """Sessions as records."""

    def create(self, request: schemas.SessionRequest, key: CallersKey | None) -> Kept[schemas.Session]:
        """Record a new session; one at a time."""

    def page(self, cursor: str | None, limit: int, wanted: SessionFilter = ALL_SESSIONS) -> schemas.SessionPage:
        """List sessions, newest first."""

    def detail(self, session_id: str) -> schemas.SessionDetail:
        """Read one, as it stands now."""

    def transitions(
        self, session_id: str, cursor: str | None, limit: int, wanted: TransitionFilter = ALL_TRANSITIONS
    ) -> schemas.TransitionPage:
        """List its gate's transitions, oldest first."""


SampleFormat = Literal["csv", "arrow", "parquet"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampleExport:
    """Samples on their way out, piece by piece."""

    pieces: Iterator[bytes]
    media_type: str
    file_name: str


class SamplesPort(Protocol):
    """What was measured."""

    def export(self, session_id: str, form: SampleFormat) -> SampleExport:
        """Write a session's samples, as far as there are any."""


class RunnerPort(Protocol):
    """The one session that runs."""

    def start(self, session_id: str, operator: str) -> schemas.Session:
        """Start its engine, disarmed."""

    def command(
        self, session_id: str, name: CommandName, operator: str, *, may_be_done: Callable[[], None] = lambda: None
    ) -> schemas.SessionDetail:
        """Ask the engine; answers when it has done or refused it.

        ``may_be_done`` is called, before anything waits for a database, unless the engine refused.
        """

    def is_running(self, session_id: str) -> bool:
        """Whether this session has an engine now, from memory."""

    def stop(self, session_id: str, operator: str) -> schemas.Session:
        """Hold the beam, end the engine, close the session; never refused while there is something to stop."""

    def retrain(self, session_id: str, operator: str, *, keeps_reference: bool) -> schemas.SessionDetail:
        """Learn a new model in the background."""

    def apply_model(self, session_id: str, operator: str) -> schemas.SessionDetail:
        """Let the model that waits take over; disarms."""

    def activate(self, model_id: str, operator: str) -> schemas.SessionDetail:
        """Measure with a stored model of the running session."""

    def correct_baseline(self, session_id: str, request: BaselineCorrectionRequest) -> schemas.SessionDetail:
        """Move the window by a drift that a person saw and confirms; disarms."""

    def note_presence(self, session_id: str, operator: str) -> None:
        """Hear that a person's page is still looked at."""

    def picture(self, session_id: str) -> Picture:
        """Encode the newest colour frame."""

    def running_camera(self) -> str | None:
        """Return the running session's camera, by its calibration; None when no session runs."""

    def mesh(self, session_id: str) -> schemas.SurfaceMesh:
        """Tell the surface of the newest frame."""

    def newest(self) -> LiveFrame | None:
        """Return the newest frame, or None when no session runs; the same object while nothing is newer."""

    def now_ns(self) -> int:
        """Return the engine's clock, to tell a message's age."""


class CalibrationsPort(Protocol):
    """Stored camera calibrations."""

    def upload(self, body: bytes, operator: str, key: CallersKey | None) -> Kept[UploadedCalibration]:
        """Check and keep one; the same content again is the same calibration."""

    def page(self, cursor: str | None, limit: int, camera: str | None = None) -> CalibrationPage:
        """List them, newest first."""

    def detail(self, calibration_id: str) -> CalibrationDetail:
        """Read one."""


class PlansPort(Protocol):
    """RT Plans."""

    def taking_one(self) -> AbstractContextManager[None]:
        """Take a place for a file; raise PlanBusyError at once where there is none."""

    def keep(self, body: bytes, operator: str, key: CallersKey | None) -> Kept[Plan]:
        """Read a file and keep what it says; the same plan again is the plan that is there."""

    def page(self, cursor: str | None, limit: int, *, patient_reference: str | None, label: str | None) -> PlanPage:
        """List them, newest first."""

    def detail(self, plan_id: str) -> Plan:
        """Read one."""


class PlannedSessionsPort(Protocol):
    """Sessions prepared from plans."""

    def prepare(
        self, plan_id: str, request: PlanSessionRequest, caller: Calling, key: CallersKey | None
    ) -> Kept[PreparedSession]:
        """Record a new session of a plan's fraction."""


class ModelsPort(Protocol):
    """Learned motion models."""

    def page(self, session_id: str, cursor: str | None, limit: int) -> ModelPage:
        """List a session's models, newest first."""

    def get(self, model_id: str) -> Model:
        """Read one."""

    def spectrum(self, model_id: str) -> Spectrum:
        """Tell how much each component explains."""


class AuditPort(Protocol):
    """The audit log."""

    def page(self, cursor: str | None, limit: int, session_id: str | None, wanted: AuditFilter = ALL_ROWS) -> AuditPage:
        """List its rows, newest first."""

    def verify(self, after: int, limit: int) -> AuditVerification:
        """Walk a bounded part of the chain."""

    def export(self, request: ExportRequest, actor: str) -> Iterator[str]:
        """Write rows for others, piece by piece; that it was asked for is written down first."""

    def exported(self, *, actor: str, action: str, session_id: str | None, detail: dict[str, object]) -> None:
        """Write down that something leaves the house; before it does."""

    def refused(self, *, actor: str, action: str, session_id: str | None, problem: Problem) -> None:
        """Write down a call that was refused before anyone acted on it."""


class RevisionsPort(Protocol):
    """ETags of sessions, and calls that depend on them."""

    def etag(self, session_id: str) -> str:
        """Return a session's ETag."""

    def only_if(self, session_id: str, wanted: Precondition) -> AbstractContextManager[None]:
        """Let a call look and act, where nothing was decided since."""


class InterlocksPort(Protocol):
    """The reasons to hold a beam, with this site's bounds."""

    def interlocks(self) -> InterlockList:
        """List them."""


class MetricsPort(Protocol):
    """What a monitoring system reads."""

    def text(self, accept: str = "") -> tuple[bytes, str]:
        """Write the metrics in the form that is accepted; return the text and its media type."""


class HealthPort(Protocol):
    """Whether everything a session needs is there."""

    def readiness(self) -> Readiness:
        """Say what is missing, if anything."""
