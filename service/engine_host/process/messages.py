"""Messages between the service and its engine process. Times are host monotonic [ns], which both processes share."""

from dataclasses import dataclass

from engine.calibration import Calibration
from engine.control import Command, EngineStatus, FrameRecord, GateTransition
from engine.core.errors import TidegateError
from engine.core.gate_state import HoldReason
from engine.core.learning_status import LearningEvent
from engine.motion import PipelineSettings
from service.core.schemas import sessions
from service.core.settings.settings import Settings
from service.engine_host.roles import SessionPlan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prepare:
    """To a process that has just started: the settings of the engine it will run."""

    settings: Settings
    measuring: PipelineSettings | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ListDevices:
    """Request the list of cameras; only before a session."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadRegistration:
    """Request the nominal calibration of a camera, or of the first one; only before a session."""

    uri: str | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraAnswer:
    """The answer to a camera request: a list of cameras, a calibration, or the error."""

    answer: sessions.DeviceList | Calibration | None = None
    error: BaseException | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Open:
    """Start this session; its journal file, if it has one, was passed on the control channel before."""

    plan: SessionPlan
    has_journal: bool
    sent_ns: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Opened:
    """The session has started, or the error that prevented it."""

    error: BaseException | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Ready:
    """All modules are imported: a session can start without delay."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CommandMessage:
    """A command to execute; ``slot`` is its cancellation flag on the shared page, None if it cannot be cancelled."""

    number: int
    slot: int | None
    command: Command
    submitted_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Heartbeat:
    """That the service serves, and the totals that its writer has taken and the audit has committed.

    ``alive_ns`` is when the web server's event loop last turned: while it is blocked no hold by hand could arrive.
    """

    alive_ns: int
    samples: int
    transitions: int
    notices: int
    acknowledged: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Presence:
    """The operator is present at the page."""

    operator: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """A failure outside of the engine, which faults the gate."""

    reason: HoldReason
    detail: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """Hold the beam, then end."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CommandResult:
    """The result of a command; ``error`` is None where it was executed."""

    number: int
    error: BaseException | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EngineUpdate:
    """Everything new since the last update.

    ``status`` comes without its view and its model where they have not changed, and the view without its picture, which
    is in shared memory. Answers are given after all else was taken over.
    """

    samples: tuple[FrameRecord, ...] = ()
    transitions: tuple[GateTransition, ...] = ()
    notices: tuple[LearningEvent, ...] = ()
    status: EngineStatus
    answers: tuple[CommandResult, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FinalReport:
    """The process's last message: the journal's newest number, and what the audit records of the tape."""

    newest_committed: int
    evidence: dict[str, object]


class EngineFailedError(TidegateError):
    """An unexpected error of the engine process; only its type is passed to the service."""

    code = "engine_failed"


def portable(error: BaseException) -> BaseException:
    """Return an error that the service can unpickle: a TidegateError itself, any other by its type's name."""
    return error if isinstance(error, TidegateError) else EngineFailedError(type(error).__name__)
