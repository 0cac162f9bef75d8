"""Where a service's engine lives: found from outside the service."""

from pathlib import Path

MARK = "engine_process"


def engine_pid(service_pid: int, mark: str = MARK) -> int:
    """The engine's process of a service; the one that runs a session, or the one that stands by."""
    (found,) = engine_pids(service_pid, mark)
    return found


def engine_pids(service_pid: int, mark: str = MARK) -> list[int]:
    """All processes of a service that are engines, or are about to be."""
    return [pid for pid in _children(service_pid) if mark in _words(pid)]


def _children(pid: int) -> list[int]:
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        found += [int(one) for one in task.read_text().split()]
    return found


def _words(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except OSError:
        return ""
