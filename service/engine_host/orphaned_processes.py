"""Engine processes that outlived their service: found by the journal that they hold open, and killed.

A process that still has its journal open after a start's patience hangs, or was stopped and may continue: it could
drive the same beam line beside a new session's engine. No service is left that could stop it. Its beam line's lease
expires once the process is killed.
"""

import os
import signal
from pathlib import Path

PROCESSES = Path("/proc")
MODULES = {b"service.engine_host.process", b"service.engine_process"}
"""The module that an engine process runs: the present name, and the earlier one for the start after an upgrade."""


def end_engines_holding(path: Path) -> list[int]:
    """Kill every engine process of this user that has the file open; return their process ids, ascending."""
    found = path.stat()
    process_ids = [
        int(one.name) for one in PROCESSES.iterdir() if one.name.isdecimal() and int(one.name) != os.getpid()
    ]
    return [one for one in sorted(process_ids) if _kill_if_engine(one, (found.st_dev, found.st_ino))]


def _kill_if_engine(process_id: int, file: tuple[int, int]) -> bool:
    """Kill the process where it is such an engine; by its descriptor, because its id may be reused meanwhile."""
    try:
        process = os.pidfd_open(process_id)
    except OSError:
        return False  # ended meanwhile
    try:
        is_engine = _is_engine(PROCESSES / str(process_id)) and _has_open(PROCESSES / str(process_id), file)
        if is_engine:
            signal.pidfd_send_signal(process, signal.SIGKILL)
    except OSError:
        return False  # ended meanwhile, or of another user
    else:
        return is_engine
    finally:
        os.close(process)


def _is_engine(process: Path) -> bool:
    arguments = (process / "cmdline").read_bytes().split(b"\0")
    return process.stat().st_uid == os.geteuid() and not MODULES.isdisjoint(arguments)


def _has_open(process: Path, file: tuple[int, int]) -> bool:
    for descriptor in (process / "fd").iterdir():
        try:
            found = descriptor.stat()
        except OSError:
            continue  # closed meanwhile
        if (found.st_dev, found.st_ino) == file:
            return True
    return False
