"""The training process: waits for jobs, and forks a process for each, which ends with it.

Whatever a job allocates is freed with its process, and whatever happens to that process leaves the engine's untouched.
Frames win: this process and its jobs run at a lower priority, and the kernel ends a job first where memory runs out.
"""

import contextlib
import gc
import os
import signal
import socket
import struct
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, cast

from engine.core.errors import ModelError
from engine.core.native_threads import keep_calls_in_their_thread
from engine.core.parent_death import signal_at_parent_death
from engine.motion.learning.trainer import outcome_of
from engine.motion.training_process.shared_value import SharedValueError, read_value, write_value

if TYPE_CHECKING:
    from collections.abc import Callable

REQUEST = struct.Struct("<q")
"""The number of a job; the memory files of its request and of its answer come with the message."""
REPORT = struct.Struct("<qqq")
"""The number of a job, the id of its process, and that one's exit status, `RUNNING` when it has started."""
RUNNING = -1
FAILED = 1
_FIRST_TO_DIE = b"1000"


class Refusal:
    """A ModelError as it is sent: its constructor's arguments are not kept, so that it cannot be pickled."""

    def __init__(self, error: ModelError) -> None:
        self._kind, self._texts, self._fields = type(error), error.args, dict(vars(error))

    def error(self) -> ModelError:
        """Return an error that is equal to it."""
        error = self._kind.__new__(self._kind)
        error.args = self._texts
        vars(error).update(self._fields)
        return error


def serve(channel: socket.socket, parent: int) -> NoReturn:
    """Run one job after another until the channel closes; never return."""
    status = FAILED
    try:
        signal_at_parent_death(signal.SIGKILL)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # the engine decides when this ends
            signal.signal(number, signal.SIG_IGN)
        keep_calls_in_their_thread()
        gc.collect()
        gc.freeze()  # a job's collections do not write to the pages that it shares with this process
        while os.getppid() == parent and _serve_one(channel):
            pass
        status = 0
    finally:
        os._exit(status)


def _serve_one(channel: socket.socket) -> bool:
    """Run one job; return False where the engine has closed the channel."""
    message, files, _, _ = socket.recv_fds(channel, REQUEST.size, 2)
    if not message:
        return False
    (number,) = REQUEST.unpack(message)
    server = os.getpid()
    process_id = os.fork()
    if process_id == 0:
        _run_job(files[0], files[1], server)
    for file in files:
        os.close(file)
    channel.send(REPORT.pack(number, process_id, RUNNING))
    _, status = os.waitpid(process_id, 0)
    channel.send(REPORT.pack(number, process_id, status))
    return True


def _run_job(request: int, answer: int, server: int) -> NoReturn:
    """Run a job in this process and end; the status is 0 once the whole answer is written."""
    status = FAILED
    try:
        signal_at_parent_death(signal.SIGKILL)
        if os.getppid() == server:
            with contextlib.suppress(OSError):
                Path("/proc/self/oom_score_adj").write_bytes(_FIRST_TO_DIE)
            job = cast("Callable[[], object]", read_value(request))
            outcome = outcome_of(job)
            write_value(answer, [Refusal(outcome) if isinstance(outcome, ModelError) else outcome])
            status = 0
    except (SharedValueError, MemoryError) as error:
        sys.stderr.write(f"a training job failed: {type(error).__name__}: {error}\n")
    finally:
        os._exit(status)
