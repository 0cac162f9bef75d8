"""What the service and its engine's process tell each other. Times are host monotonic, which both share."""

from dataclasses import dataclass

from engine.calibration import Calibration
from engine.commands import Command
from engine.errors import TidegateError
from engine.likeness import Likeness
from engine.live import FrameRecord, GateTransition, LiveView, LoopStatus
from engine.model import MotionModel
from engine.notices import LearningNotice
from engine.permits import HoldReason
from engine.pipeline import PipelineSettings
from service import schemas
from service.ports import SessionPlan
from service.settings import Settings


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prepare:
    """To a process that was just started: whose engine it will be."""

    settings: Settings
    measuring: PipelineSettings | None


@dataclass(frozen=True, slots=True, kw_only=True)
class AskDevices:
    """Which cameras are there? Only before a session."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AskRegistered:
    """What does this camera, or the first, say of its own registration? Only before a session."""

    uri: str | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Told:
    """What a question was answered with: a list of cameras, a calibration, or why there is none."""

    answer: schemas.DeviceList | Calibration | None = None
    error: BaseException | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Open:
    """Begin this session; its journal, if it has one, has been handed over before."""

    plan: SessionPlan
    has_journal: bool
    sent_ns: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Opened:
    """The session has begun, or why not."""

    error: BaseException | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Ready:
    """Everything is imported: a session can begin at once."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Order:
    """A command; ``slot`` is where the page says that its asker has given up, if that is to matter."""

    number: int
    slot: int | None
    command: Command
    submitted_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Beat:
    """The service was alive then; and how much the writer has taken so far, and the audit confirmed."""

    alive_ns: int
    samples: int
    transitions: int
    notices: int
    confirmed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Presence:
    """A person's page is looked at."""

    operator: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """Something around the engine failed."""

    reason: HoldReason
    detail: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """Hold the beam, then end."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answer:
    """What came of an order."""

    number: int
    error: BaseException | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """Where on the page the newest view's picture lies."""

    number: int
    frame_index: int
    shape: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Standing:
    """What can be read of an engine at any time."""

    status: LoopStatus = LoopStatus.STARTING
    error: str | None = None
    has_reference: bool = False
    likeness: Likeness | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class News:
    """Everything new since the last; what is None has not changed. Answers are given after all else is in its place."""

    samples: tuple[FrameRecord, ...] = ()
    transitions: tuple[GateTransition, ...] = ()
    notices: tuple[LearningNotice, ...] = ()
    view: LiveView | None = None
    shown: Shown | None = None
    model: MotionModel | None = None
    standing: Standing
    answers: tuple[Answer, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Farewell:
    """The last word: how far the journal came, and what the audit keeps of the tape."""

    newest_told: int
    evidence: dict[str, object]


class EngineFailedError(TidegateError):
    """An error of the engine's process that was not raised on purpose; its kind alone is told."""

    code = "engine_failed"


def portable(error: BaseException) -> BaseException:
    """Return an error that can cross: our own as it is, any other by its kind."""
    return error if isinstance(error, TidegateError) else EngineFailedError(type(error).__name__)
