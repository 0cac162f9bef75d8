"""What processes use of the machine, from ``/proc``: time of the cores, waiting for one, memory, threads, files."""

import contextlib
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")
PROC = Path("/proc")
NS_PER_S = 1e9
BUSY = (0, 1, 2, 5, 6, 7)
"""Of the columns of the first line of ``/proc/stat``: at work for a program or for the system."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Usage:
    """A process and all that it started, at one moment; ``waited_s`` is how long its threads wanted a core in vain.

    ``own_mb`` is the part of the resident memory that is no file's, and not shared.
    """

    at_s: float
    processor_s: float
    waited_s: float
    resident_mb: float
    own_mb: float
    threads: int
    files: int
    processes: int


def usage_of(process_id: int) -> Usage:
    """Sum up a process and its descendants."""
    members = list(family(process_id))
    memory = [_memory_mb(one) for one in members]
    return Usage(
        at_s=time.monotonic(),
        processor_s=sum(_processor_s(one) for one in members),
        waited_s=sum(_waited_s(one) for one in members),
        resident_mb=sum(resident for resident, _ in memory),
        own_mb=sum(own for _, own in memory),
        threads=sum(_count(PROC / str(one) / "task") for one in members),
        files=sum(_count(PROC / str(one) / "fd") for one in members),
        processes=len(members),
    )


def machine_busy_s() -> float:
    """Return for how long the cores of this machine were at work since it started, in all [s]."""
    columns = [int(column) for column in (PROC / "stat").read_text().splitlines()[0].split()[1:]]
    return TICK_S * sum(columns[column] for column in BUSY)


def family(process_id: int) -> Iterator[int]:
    """Find a process and its descendants, by whom each process has for its parent."""
    children: dict[int, list[int]] = {}
    for folder in PROC.iterdir():
        if folder.name.isdigit():
            with contextlib.suppress(OSError):
                parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
                children.setdefault(parent, []).append(int(folder.name))
    found = [process_id]
    while found:
        one = found.pop()
        found += children.get(one, [])
        yield one


def _processor_s(process_id: int) -> float:
    with contextlib.suppress(OSError):
        columns = (PROC / str(process_id) / "stat").read_text().rpartition(")")[2].split()
        return TICK_S * (int(columns[11]) + int(columns[12]))
    return 0.0


def _waited_s(process_id: int) -> float:
    waited = 0.0
    with contextlib.suppress(OSError):
        for task in (PROC / str(process_id) / "task").iterdir():
            with contextlib.suppress(OSError):
                waited += int((task / "schedstat").read_text().split()[1]) / NS_PER_S
    return waited


def _memory_mb(process_id: int) -> tuple[float, float]:
    """Return what is resident, and what of it is the process's own."""
    with contextlib.suppress(OSError):
        resident, shared = (int(pages) for pages in (PROC / str(process_id) / "statm").read_text().split()[1:3])
        mb_a_page = os.sysconf("SC_PAGE_SIZE") / 1e6
        return resident * mb_a_page, (resident - shared) * mb_a_page
    return 0.0, 0.0


def _count(folder: Path) -> int:
    with contextlib.suppress(OSError):
        return len(list(folder.iterdir()))
    return 0
