"""The training process: waits for jobs, and forks a process for each, which ends with it.

Whatever a job allocates is freed with its process, and whatever happens to that process leaves the engine's untouched.
Frames win: this process and its jobs run at a lower priority, and the kernel ends a job first where memory runs out.

A value in a memory file, which another process maps: its arrays are written once, and never copied by the reader.

A file holds a head, the pickled value, and the contents of its arrays, each aligned for vector instructions. Writing
releases the interpreter's lock, and the arrays that are read are read-only.
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
from engine.core.native_process import keep_calls_in_their_thread, signal_at_parent_death
from engine.motion.learning.trainer import outcome_of

if TYPE_CHECKING:
    from collections.abc import Callable
import mmap
import pickle
from collections.abc import Sequence
from typing import TypeVar

from engine.core.errors import TidegateError

T = TypeVar("T")

ALIGNMENT = 64
_HEAD = struct.Struct("<8sQ")
_LENGTH = struct.Struct("<Q")
_MARK = b"tdgvalue"
_PARTS_AT_ONCE = 1000
"""Below the system's limit of buffers in one call, 1024."""
REQUEST = struct.Struct("<q")
"""The number of a job; the memory files of its request and of its answer come with the message."""
REPORT = struct.Struct("<qqq")
"""The number of a job, the id of its process, and that one's exit status, `RUNNING` when it has started."""
RUNNING = -1
FAILED = 1
_FIRST_TO_DIE = b"1000"


class SharedValueError(TidegateError):
    """A memory file cannot be written, or does not hold a whole value."""

    code = "shared_value_invalid"


def make_file() -> int:
    """Create an empty memory file, and return its descriptor; its memory is freed with its last user."""
    return os.memfd_create("tidegate-training", os.MFD_CLOEXEC)


def write_value(file: int, values: list[T]) -> None:
    """Write the only value of a list into an empty memory file; its arrays are let go one by one, to hold no lock long.

    Raises
    ------
    SharedValueError
        There is not enough memory.
    """
    buffers: list[pickle.PickleBuffer] = []
    pickled = pickle.dumps(values[0], protocol=5, buffer_callback=buffers.append)
    values.clear()
    contents: list[bytes | memoryview] = [pickled, *(buffer.raw() for buffer in buffers)]
    lengths = [len(content) for content in contents]
    head = _HEAD.pack(_MARK, len(contents)) + b"".join(map(_LENGTH.pack, lengths))
    parts: list[bytes | memoryview] = []
    for content in (head, *contents):
        parts += [content, bytes(-len(content) % ALIGNMENT)]
    for start in range(0, len(parts), _PARTS_AT_ONCE):
        _write(file, parts[start : start + _PARTS_AT_ONCE])
    parts.clear()
    contents.clear()
    while buffers:
        buffers.pop()


def _write(file: int, parts: Sequence[bytes | memoryview]) -> None:
    try:
        written = os.writev(file, parts)
    except OSError as error:
        raise SharedValueError(f"a value cannot be handed to another process: {error.strerror}") from error
    if written != sum(map(len, parts)):
        msg = "a value cannot be handed to another process: not enough memory"
        raise SharedValueError(msg)


def read_value(file: int) -> object:
    """Map a memory file and return its value; the memory is freed with the last of the value's arrays.

    Raises
    ------
    SharedValueError
        The file does not hold a whole value.
    """
    size = os.fstat(file).st_size
    if size < _HEAD.size:
        msg = "a value from another process is incomplete"
        raise SharedValueError(msg)
    memory = memoryview(mmap.mmap(file, size, prot=mmap.PROT_READ))
    mark, count = _HEAD.unpack_from(memory)
    if mark != _MARK or size < _HEAD.size + count * _LENGTH.size:
        msg = "a value from another process is damaged"
        raise SharedValueError(msg)
    lengths = [_LENGTH.unpack_from(memory, _HEAD.size + place * _LENGTH.size)[0] for place in range(count)]
    at, contents = _aligned(_HEAD.size + count * _LENGTH.size), []
    for length in lengths:
        contents.append(memory[at : at + length])
        at = _aligned(at + length)
    if at != size:
        raise SharedValueError(f"a value from another process has {size} bytes instead of {at}")
    return pickle.loads(contents[0], buffers=contents[1:])  # noqa: S301 - of this program's own processes # nosec B301


def _aligned(at: int) -> int:
    return at + -at % ALIGNMENT


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
