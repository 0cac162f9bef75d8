"""The machine: what it is, how fast it copies, how busy others keep it, and fresh processes on chosen cores of it."""

import ctypes
import gc
import multiprocessing
import os
import platform
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import ParamSpec, TypeVar

import cv2
import numpy as np

from engine.errors import TidegateError
from engine.memory import keep_freed_memory
from engine.threads import keep_calls_in_their_thread

COPIED_BYTES = 1 << 26
COPIES = 15
BUSY_LOAD = 1.0
_HEAP_FIELDS = (
    *("arena", "ordblks", "smblks", "hblks", "hblkhd"),
    *("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
)

P = ParamSpec("P")
T = TypeVar("T")


class SpeedBenchError(TidegateError):
    """A part of the bench could not be done."""

    code = "speed_bench_failed"


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """What the figures were measured on.

    Attributes
    ----------
    cores
        Those that this process may use.
    load_average
        Of the last minute, before anything was measured.
    """

    processor: str
    cores: tuple[int, ...]
    memory_gb: float
    system: str
    python: str
    numpy: str
    opencv: str
    load_average: float

    @property
    def is_busy(self) -> bool:
        """Whether others were at work before the bench began."""
        return self.load_average > BUSY_LOAD

    @property
    def pairs(self) -> tuple[int, int] | None:
        """Two cores; None where there is one."""
        return (self.cores[-2], self.cores[-1]) if len(self.cores) > 1 else None


def this_machine() -> Machine:
    """Describe the machine as it is now."""
    return Machine(
        processor=_processor(),
        cores=tuple(sorted(os.sched_getaffinity(0))),
        memory_gb=round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        system=f"{platform.system()} {platform.release()}",
        python=platform.python_version(),
        numpy=np.__version__,
        opencv=cv2.__version__,
        load_average=os.getloadavg()[0],
    )


def copy_bandwidth_bytes_s() -> float:
    """Measure how many bytes a second a large copy reads and writes, both counted."""
    source, target = (np.ones(COPIED_BYTES, dtype=np.uint8) for _ in range(2))
    durations_ns = []
    for _ in range(COPIES):
        started_ns = time.perf_counter_ns()
        np.copyto(target, source)
        durations_ns.append(time.perf_counter_ns() - started_ns)
    return 2.0 * COPIED_BYTES / float(np.median(durations_ns)) * 1e9


def settle_as_the_service(switch_interval_s: float) -> None:
    """Set this process up as the service sets itself up."""
    keep_calls_in_their_thread()
    keep_freed_memory()
    sys.setswitchinterval(switch_interval_s)


def set_memory_aside() -> None:
    """Keep the collector away from what lives as long as the process, as the service does."""
    gc.collect()
    gc.freeze()


def resident_bytes() -> int:
    """Memory of this process that is in use now [bytes]."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


class _HeapState(ctypes.Structure):
    """What ``mallinfo2`` returns; <malloc.h>."""

    _fields_ = tuple((name, ctypes.c_size_t) for name in _HEAP_FIELDS)


def heap_in_use_bytes() -> float:
    """Memory that the C library has given out and not got back [bytes]; NaN where it cannot tell (no glibc)."""
    ask = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if ask is None:
        return float("nan")
    ask.restype = _HeapState
    state = ask()
    return float(state.uordblks + state.hblkhd)


@contextmanager
def pinned(cores: Sequence[int]) -> Iterator[None]:
    """Let processes started within run on these cores only."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def on_cores(cores: Sequence[int], work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Do ``work`` in a fresh process on these cores, and return what it returned.

    Raises
    ------
    SpeedBenchError
        It could not be done.
    """
    context = multiprocessing.get_context("spawn")  # a fork would copy the threads' locks of whoever calls
    answers, tell = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(tell, work, args, kwargs), name="tidegate-bench", daemon=True)
    with pinned(cores):
        process.start()
    tell.close()  # the child's end is the only one left: it ends with the child
    try:
        is_done, answer = answers.recv()
    except EOFError as error:
        process.join()
        msg = f"a measuring process ended early (exit code {process.exitcode})"
        raise SpeedBenchError(msg) from error
    finally:
        process.terminate()
        process.join()
    if not is_done:
        raise SpeedBenchError(answer)
    value: T = answer
    return value


def _work(tell: Connection, work: Callable[..., object], args: tuple[object, ...], kwargs: dict[str, object]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent's to answer, which then ends this one
    try:
        tell.send((True, work(*args, **kwargs)))
    except TidegateError as error:
        tell.send((False, str(error)))


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
