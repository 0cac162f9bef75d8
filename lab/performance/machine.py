"""Description of the machine, and measuring processes pinned to chosen cores.

Statistics of measured times: medians over blocks, which other programs on the machine disturb least.
"""

import ctypes
import gc
import multiprocessing
import os
import platform
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import ParamSpec, TypeVar

import cv2
import numpy as np

from engine.core.clock import NS_PER_S, NS_PER_US
from engine.core.compiled import frame_path
from engine.core.errors import TidegateError
from engine.core.frames import FloatArray
from engine.core.native_process import keep_calls_in_their_thread, keep_freed_memory

BUSY_LOAD = 1.0
_HEAP_FIELDS = (
    *("arena", "ordblks", "smblks", "hblks", "hblkhd"),
    *("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
)

P = ParamSpec("P")
T = TypeVar("T")


class SpeedBenchError(TidegateError):
    """A part of the benchmark failed."""

    code = "speed_bench_failed"


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """Machine and software versions that the figures were measured with.

    Attributes
    ----------
    caches
        Sizes of the last core's caches of data, nearest first.
    cores
        Cores that this process may use.
    load_average
        Load average of the last minute before the benchmark.
    """

    processor: str
    caches: str
    cores: tuple[int, ...]
    memory_gb: float
    system: str
    python: str
    numpy: str
    opencv: str
    frame_path: str
    load_average: float

    @property
    def is_busy(self) -> bool:
        """Whether other processes were running before the benchmark."""
        return self.load_average > BUSY_LOAD

    @property
    def pairs(self) -> tuple[int, int] | None:
        """Two cores; None if there is only one."""
        return (self.cores[-2], self.cores[-1]) if len(self.cores) > 1 else None


def this_machine() -> Machine:
    """Describe the machine and its current load."""
    return Machine(
        processor=_processor(),
        caches=_caches(max(os.sched_getaffinity(0))),
        cores=tuple(sorted(os.sched_getaffinity(0))),
        memory_gb=round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        system=f"{platform.system()} {platform.release()}",
        python=platform.python_version(),
        numpy=np.__version__,
        opencv=cv2.__version__,
        frame_path=frame_path(),
        load_average=os.getloadavg()[0],
    )


def settle_as_the_service(switch_interval_s: float) -> None:
    """Configure threads, memory and interpreter of this process as the service does."""
    keep_calls_in_their_thread()
    keep_freed_memory()
    sys.setswitchinterval(switch_interval_s)


def set_memory_aside() -> None:
    """Exclude all present objects from garbage collection, as the service does."""
    gc.collect()
    gc.freeze()


def resident_bytes() -> int:
    """Resident memory of this process [bytes]."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def own_bytes_of_children() -> int:
    """Memory of all processes below this one that they share with no other [bytes]."""
    return sum(_own_bytes(process) for process in _below(os.getpid()))


def _below(process: int) -> Iterator[int]:
    children: dict[int, list[int]] = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            with suppress(OSError):
                parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
                children.setdefault(parent, []).append(int(folder.name))
    found = list(children.get(process, ()))
    while found:
        child = found.pop()
        found += children.get(child, ())
        yield child


def _own_bytes(process: int) -> int:
    with suppress(OSError):
        lines = Path(f"/proc/{process}/smaps_rollup").read_text(encoding="ascii").splitlines()
        return 1024 * sum(int(line.split()[1]) for line in lines if line.startswith("Private_"))
    return 0


class _HeapState(ctypes.Structure):
    """Result of ``mallinfo2`` (<malloc.h>)."""

    _fields_ = tuple((name, ctypes.c_size_t) for name in _HEAP_FIELDS)


def heap_in_use_bytes() -> float:
    """Memory allocated from the C library and not freed [bytes]; NaN without glibc's ``mallinfo2``."""
    mallinfo2 = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if mallinfo2 is None:
        return float("nan")
    mallinfo2.restype = _HeapState
    state = mallinfo2()
    return float(state.uordblks + state.hblkhd)


@contextmanager
def pinned(cores: Sequence[int]) -> Iterator[None]:
    """Restrict processes started inside the block to these cores."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def on_cores(cores: Sequence[int], work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Run ``work`` in a fresh process on these cores and return its result.

    Raises
    ------
    SpeedBenchError
        ``work`` raised a TidegateError, or the process ended early.
    """
    context = multiprocessing.get_context("spawn")  # a fork would copy the locks of the caller's threads
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(sender, work, args, kwargs), name="tidegate-bench", daemon=True)
    with pinned(cores):
        process.start()
    sender.close()  # only the child's copy stays open, so the pipe ends with the child
    try:
        is_done, answer = receiver.recv()
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


def _work(sender: Connection, work: Callable[..., object], args: tuple[object, ...], kwargs: dict[str, object]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles it and terminates this process
    try:
        sender.send((True, work(*args, **kwargs)))
    except TidegateError as error:
        sender.send((False, str(error)))


def _caches(core: int) -> str:
    found = []
    for folder in sorted(Path(f"/sys/devices/system/cpu/cpu{core}/cache").glob("index*")):
        with suppress(OSError):
            if (folder / "type").read_text().strip() != "Instruction":
                found.append((folder / "size").read_text().strip())
    return ", ".join(found) or "unknown"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """Statistics of many durations.

    Attributes
    ----------
    median_us, p99_us
        Median over the blocks of each block's median and 99th percentile [us].
    p999_us, max_us
        99.9th percentile and largest of all samples together [us].
    """

    median_us: float
    p99_us: float
    p999_us: float
    max_us: float
    samples: int
    blocks: int


def timing_of(blocks_ns: Sequence[FloatArray]) -> Timing:
    """Compute the statistics of blocks of durations [ns], shape (samples,) each; all NaN if there are none."""
    filled = [np.asarray(block, dtype=np.float64) / NS_PER_US for block in blocks_ns if len(block)]
    if not filled:
        nan = float("nan")
        return Timing(median_us=nan, p99_us=nan, p999_us=nan, max_us=nan, samples=0, blocks=0)
    everything = np.concatenate(filled)
    return Timing(
        median_us=float(np.median([np.median(block) for block in filled])),
        p99_us=float(np.median([np.percentile(block, 99.0) for block in filled])),
        p999_us=float(np.percentile(everything, 99.9)),
        max_us=float(everything.max()),
        samples=len(everything),
        blocks=len(filled),
    )


def frames_per_s(stamps_ns: FloatArray) -> float:
    """Mean rate of events at these times [1/s]; NaN for fewer than two."""
    if len(stamps_ns) < 2:
        return float("nan")
    return (len(stamps_ns) - 1) * NS_PER_S / float(stamps_ns[-1] - stamps_ns[0])
