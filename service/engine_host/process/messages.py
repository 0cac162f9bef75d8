"""Messages between the service and its engine process. Times are host monotonic [ns], which both processes share.

An engine process as the service sees it: the process, its two channels and the shared page.
"""

import contextlib
import os
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from engine.calibration import Calibration
from engine.control import Command, EngineStatus, FrameRecord, GateTransition
from engine.core.compiled import VARIABLE as FRAME_PATH
from engine.core.errors import TidegateError
from engine.core.gate_state import HoldReason
from engine.core.learning_status import LearningEvent
from engine.motion import PipelineSettings
from service.core.schemas import sessions
from service.core.settings.names import PREFIX
from service.core.settings.settings import Settings
from service.engine_host.process.channels import BulkChannel, ControlChannel, SharedPage
from service.engine_host.protocols import SessionPlan

MODULE = "service.engine_host.process"
CODE = Path(__file__).parents[3]
"""The folder that this program was loaded from: the engine process runs the same code."""
END_S = 5.0


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


def portable(error: BaseException) -> BaseException:
    """Return an error that the service can unpickle: a TidegateError itself, any other by its type's name."""
    return error if isinstance(error, TidegateError) else EngineFailedError(type(error).__name__)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ChildProcess:
    """A running engine process with the service's ends of its channels."""

    process: "subprocess.Popen[bytes]"
    bulk: BulkChannel
    control: ControlChannel
    page: SharedPage

    @property
    def is_alive(self) -> bool:
        """Whether it has not ended."""
        return self.process.poll() is None

    def kill(self) -> None:
        """Kill it; its beam line's lease expires."""
        with contextlib.suppress(OSError):
            self.process.kill()

    def reap(self) -> int:
        """Close its channels, wait for its end, and kill it after 5 s; return its exit status."""
        self.bulk.close()
        self.control.close()
        try:
            status = self.process.wait(END_S)
        except subprocess.TimeoutExpired:
            self.kill()
            status = self.process.wait()
        return status


def start_child() -> ChildProcess:
    """Start a process; after the settings it sends ``Ready``, once it has imported everything."""
    bulk, child_bulk = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    control, child_control = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    page_file = SharedPage.make()
    its_files = (child_bulk.fileno(), child_control.fileno(), page_file)
    try:
        process = subprocess.Popen(  # noqa: S603 - this very program
            [sys.executable, "-P", "-m", MODULE, *(str(file) for file in its_files)],
            pass_fds=its_files,
            stdin=subprocess.DEVNULL,
            env=_environment(),
            process_group=0,  # Ctrl-C in a terminal must reach the service only
        )
        page = SharedPage(page_file)
    except OSError:
        for end in (bulk, control):
            end.close()
        raise
    finally:
        child_bulk.close()
        child_control.close()
        os.close(page_file)
    return ChildProcess(process=process, bulk=BulkChannel(bulk), control=ControlChannel(control), page=page)


def _environment() -> dict[str, str]:
    """Return the environment without settings, which may hold secrets: they are sent in a message.

    Except the form of the frame path, which is chosen when the engine is imported.
    """
    inherited = {
        name: value for name, value in os.environ.items() if name == FRAME_PATH or not name.upper().startswith(PREFIX)
    }
    paths = (str(CODE), *filter(None, [inherited.get("PYTHONPATH")]))  # plug-ins may lie there
    return {**inherited, "PYTHONPATH": os.pathsep.join(paths)}
