"""An engine process as the service sees it: the process, its two channels and the shared page."""

import contextlib
import os
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from engine.core.compiled import VARIABLE as FRAME_PATH
from service.core.settings.names import PREFIX
from service.engine_host.process.channels import BulkChannel, ControlChannel, SharedPage

MODULE = "service.engine_host.process"
CODE = Path(__file__).parents[3]
"""The folder that this program was loaded from: the engine process runs the same code."""
END_S = 5.0


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
    return {**inherited, "PYTHONPATH": str(CODE)}
