"""Engines' processes that outlived their service: found by the journal that they hold, and ended.

One that still has its journal open after a start's patience hangs, or was stopped and may go on: it could tell the same
line beside a new session's engine. Nobody is left who could ask it to end. Its line lapses by itself once it is killed.
"""

import os
import signal
from pathlib import Path

PROCESSES = Path("/proc")
MODULE = b"service.engine_process"


def end_engines_holding(path: Path) -> list[int]:
    """Kill every engine's process of this user that has the file open; returns their numbers."""
    wanted = path.stat()
    numbers = [int(one.name) for one in PROCESSES.iterdir() if one.name.isdecimal() and int(one.name) != os.getpid()]
    return [number for number in sorted(numbers) if _ended(number, (wanted.st_dev, wanted.st_ino))]


def _ended(number: int, file: tuple[int, int]) -> bool:
    """Kill one where it is such a process; held by its descriptor, for a number may be another's meanwhile."""
    try:
        process = os.pidfd_open(number)
    except OSError:
        return False  # it ended by itself
    try:
        is_one = _is_engine(PROCESSES / str(number)) and _has_open(PROCESSES / str(number), file)
        if is_one:
            signal.pidfd_send_signal(process, signal.SIGKILL)
    except OSError:
        return False  # it ended meanwhile, or is another user's
    else:
        return is_one
    finally:
        os.close(process)


def _is_engine(process: Path) -> bool:
    return process.stat().st_uid == os.geteuid() and MODULE in (process / "cmdline").read_bytes().split(b"\0")


def _has_open(process: Path, file: tuple[int, int]) -> bool:
    for one in (process / "fd").iterdir():
        try:
            found = one.stat()
        except OSError:
            continue  # closed meanwhile
        if (found.st_dev, found.st_ino) == file:
            return True
    return False
