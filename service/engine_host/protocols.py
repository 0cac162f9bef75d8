"""The roles that the service sees of the engine and of a running session; tests put fakes there.

`service.engine_host.local_engine` and `service.engine_host.process.process_engine` fill :class:`EnginePort`.
"""

import queue
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol

from engine.calibration import Calibration
from engine.control import Command, EngineStatus, FrameRecord, GateTransition, TransitionJournal
from engine.core.fraction_arming import FractionArming
from engine.core.frames import ColorImage
from engine.core.gate_state import HoldReason
from engine.core.learning_status import LearningEvent
from engine.core.motion_model import MotionModel
from engine.core.reference import FirstReference
from engine.core.signals import HeadDirection
from service.core.schemas import sessions
from service.core.schemas.live_messages import Sample
from service.core.schemas.windows import Window

if TYPE_CHECKING:  # the engine's process does without Arrow
    from service.storage.samples.figures import Figures

CommandName = Literal["disarm", "hold"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionPlan:
    """What an engine needs to run a session; ``recording`` is None for a live camera.

    ``model`` is the stored one to begin with, None to learn one; ``head_direction`` is None if it was not given;
    ``first_reference`` is that of an earlier session of the same fraction; ``plan_position`` is that of the plan's
    first fraction, where this is another one, and ``plan_session_id`` the session that confirmed it;
    ``fraction_arming`` is what earlier sessions of the fraction were armed with;
    ``camera_latency_ms`` is what the gate counts for the camera, None for the site's value.
    """

    session_id: str
    source: sessions.RecordingSource | sessions.DeviceSource
    recording: Path | None
    calibration: Calibration
    window: Window
    regions: sessions.Regions = field(default_factory=sessions.Regions)
    patient_reference: str = ""
    model: MotionModel | None = None
    journal: TransitionJournal | None = None
    model_id: str | None = None
    head_direction: HeadDirection | None = None
    first_reference: FirstReference | None = None
    camera_latency_ms: float | None = None
    plan_position: FirstReference | None = None
    fraction_arming: FractionArming | None = None
    plan_session_id: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """The newest colour frame as JPEG."""

    frame_index: int
    jpeg: bytes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LiveFrame:
    """The newest frame as a live message, with its times of reception and, if known, of capture [ns, monotonic].

    ``status`` is the engine's status that it was made from.
    """

    message: Sample
    received_ns: int
    captured_ns: int | None = None
    status: EngineStatus | None = None


class RunningEngine(Protocol):
    """The engine of one session. All members are safe from any thread and never wait for a frame."""

    @property
    def samples(self) -> "queue.Queue[FrameRecord]":
        """One record per frame; bounded: while it is full, the gate holds."""

    @property
    def transitions(self) -> "queue.Queue[GateTransition]":
        """Every transition of the gate; bounded likewise."""

    @property
    def notices(self) -> "queue.Queue[LearningEvent]":
        """Events of the training of models; bounded likewise."""

    @property
    def status(self) -> EngineStatus:
        """The engine's status: run state, newest view, and the model and reference in use."""

    def picture(self) -> tuple[int, ColorImage] | None:
        """Return the newest frame's index and colour picture; None before there is one. A view may come without."""

    def submit(self, command: Command, *, submitted_ns: int | None = None) -> "Future[None]":
        """Submit a command; raise CommandRefusedError at once if too many are waiting.

        ``submitted_ns`` is when it was asked for, host monotonic time; now, if left out.
        """

    def note_presence(self, operator: str) -> None:
        """Note that the operator is present at the page; never waits."""

    def report_fault(self, reason: HoldReason, detail: str) -> None:
        """Fault the gate because something outside of the engine failed; ``reason`` must be one that latches."""

    def stop(self) -> None:
        """Hold the beam, then end; return when the engine has ended or does not answer in time."""

    def evidence(self) -> dict[str, object]:
        """Return what the audit records of the session's tape and raw recording, such as hashes; once it is over.

        Waits for them a few seconds at most.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyMatch:
    """How far today's body is from that of an earlier session; ``shift_mm`` is x right, y down, z away [mm].

    ``is_position_compared`` is false where the camera has another calibration: positions are then
    in another coordinate system.
    """

    session_id: str
    model_id: str
    shift_mm: tuple[float, float, float]
    tilt_deg: float
    shape_mm: float
    is_position_compared: bool
    warning: str | None


class RunningWriter(Protocol):
    """The thread that writes one running session to database and sample file."""

    @property
    def figures(self) -> "Figures":
        """Counts of what has been written."""

    @property
    def active_model_id(self) -> str | None:
        """Database id of the model that frames are measured with; None before one is stored."""

    @property
    def body(self) -> BodyMatch | None:
        """Comparison with the patient's earlier session; None without one, and before a model was learned."""

    @property
    def is_stopping(self) -> bool:
        """Whether an operator has stopped the session."""

    def stopping(self, operator: str, *, is_hurried: bool = False) -> None:
        """Note who ends the session; hurried, large sample files are settled at the next start."""

    def start(self) -> None:
        """Start the thread; once."""

    def join(self, timeout: float | None = None) -> None:
        """Wait until the session is closed [s]; raise RuntimeError before the thread is started."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunningSession:
    """A session at work: its plan, its engine, and the thread that writes it down."""

    plan: SessionPlan
    engine: RunningEngine
    writer: RunningWriter


class EnginePort(Protocol):
    """Starts engines: the service's only access to cameras, gate and beam line."""

    @property
    def is_simulated_beam(self) -> bool:
        """Whether the beam line is a simulation."""

    def open(self, plan: SessionPlan) -> RunningEngine:
        """Start an engine on a session, disarmed; raise a TidegateError when source or window cannot be used."""

    def built_in_calibration(self, uri: str | None) -> Calibration:
        """Return the calibration that a camera brings itself; refuse one that has none."""

    def devices(self) -> sessions.DeviceList:
        """List the cameras that could be used."""

    @property
    def trouble(self) -> str | None:
        """Why no session could start now; None where one could."""

    def note_server_turn(self, turned_ns: int) -> None:
        """Note that the web server's event loop turned [ns, host monotonic]; called many times a second, never waits.

        An engine in another process faults an armed gate when this stops: no hold by hand could arrive.
        """

    def close(self) -> None:
        """End the standby process, if there is one; called once no session runs."""


class LiveFeed(Protocol):
    """What the live stream reads of the running session, from memory; safe from any thread."""

    def newest(self) -> LiveFrame | None:
        """Return the newest frame, or None when no session runs; the same object while nothing is newer."""

    def running_camera(self) -> str | None:
        """Return the running session's camera, by its calibration; None when no session runs."""

    def now_ns(self) -> int:
        """Return the engine's clock [ns], which a message's age is measured with."""
