"""An engine's process as the service holds it: started, spoken to, ended; nothing of it outlives its end."""

import contextlib
import os
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from service.beam_settings import PREFIX
from service.engine_process.crossing import Speech, Whisper
from service.engine_process.page import Page

MODULE = "service.engine_process"
CODE = Path(__file__).parents[2]
"""The folder this program was loaded from: its engine's process runs the same."""
END_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Child:
    """See the module."""

    process: "subprocess.Popen[bytes]"
    speech: Speech
    whisper: Whisper
    page: Page

    @property
    def is_alive(self) -> bool:
        """Whether it has not ended."""
        return self.process.poll() is None

    def kill(self) -> None:
        """End it as it is; a line of its own lapses by itself."""
        with contextlib.suppress(OSError):
            self.process.kill()

    def bury(self) -> int:
        """Close what leads to it, and wait for its end; killed where it does not end by itself. Returns its status."""
        self.speech.close()
        self.whisper.close()
        try:
            status = self.process.wait(END_S)
        except subprocess.TimeoutExpired:
            self.kill()
            status = self.process.wait()
        return status


def start_child() -> Child:
    """Start one; it says when it is ready."""
    speech, its_speech = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    whisper, its_whisper = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    page_file = Page.make()
    its_files = (its_speech.fileno(), its_whisper.fileno(), page_file)
    try:
        process = subprocess.Popen(  # noqa: S603 - this very program
            [sys.executable, "-P", "-m", MODULE, *(str(file) for file in its_files)],
            pass_fds=its_files,
            stdin=subprocess.DEVNULL,
            env=_environment(),
            process_group=0,  # a terminal's Ctrl-C is the service's to obey
        )
        page = Page(page_file)
    except OSError:
        for end in (speech, whisper):
            end.close()
        raise
    finally:
        its_speech.close()
        its_whisper.close()
        os.close(page_file)
    return Child(process=process, speech=Speech(speech), whisper=Whisper(whisper), page=page)


def _environment() -> dict[str, str]:
    """Leave the settings out, which may hold secrets: they are told."""
    inherited = {name: value for name, value in os.environ.items() if not name.upper().startswith(PREFIX)}
    return {**inherited, "PYTHONPATH": str(CODE)}
