"""What runs in a Dask worker: it refuses other code than the client's, and does one job at a time.

Plain values come first and the job is unpickled last, so that a worker with another version can say so.

What is sent to a worker is a job: a recording to measure, or another command's. The work is that of one machine.

A job writes into a folder of its own, never where its results belong: a worker that lost its connection may still be
writing when another one does the same job. The client moves the files of the one result that it accepts.
"""

import asyncio
import pickle
import platform
import shutil
import socket
import threading
import uuid
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import scipy

import engine
from engine.core.errors import RecordingError
from engine.offline import FileOutcome, FileTask, Progress, fingerprint, measure_file

MARKER = "run"
"""File in the staging folder by which a worker knows that it sees the client's folder."""
STOP_WITHIN_S = 30.0
STOP_STEP_S = 0.05
Report = Callable[[dict[str, int | str]], None]
"""Reports progress; the values travel as MessagePack."""


class WorkerRefusedError(Exception):
    """The worker does not run the client's code."""


class JobStoppedError(Exception):
    """The client cancelled the run; no TidegateError, which would become a recording's outcome."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JobDone:
    """A finished job: the name of its folder in the staging folder, its files, and the value it returned."""

    folder: str
    files: tuple[str, ...]
    value: object


@dataclass(frozen=True, slots=True, kw_only=True)
class JobRefused:
    """A job that this worker could not do; ``reason`` names the worker."""

    reason: str


@cache
def identity() -> dict[str, str]:
    """Return what results depend on: the version and the source of Tidegate, and the numeric libraries."""
    return {
        "Tidegate": engine.__version__,
        "Python": platform.python_version(),
        "NumPy": np.__version__,
        "OpenCV": cv2.__version__,
        "SciPy": scipy.__version__,
        "engine's source": fingerprint("engine/**/*.py"),
    }


def difference(expected: dict[str, str]) -> str | None:
    """Return what is different here from the client, None if nothing is."""
    for name, mine in identity().items():
        if expected.get(name) != mine:
            return f"has {name} {mine}, this client has {expected.get(name, 'none')}"
    return None


class _Attempts:
    """The jobs that run in this process, by run, and the runs that were stopped."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: Counter[str] = Counter()
        self._stopped: set[str] = set()

    def begin(self, run_id: str) -> None:
        with self._lock:
            self.check(run_id)
            self._running[run_id] += 1

    def end(self, run_id: str) -> None:
        with self._lock:
            self._running[run_id] -= 1

    def stop(self, run_id: str) -> None:
        with self._lock:
            self._stopped.add(run_id)

    def check(self, run_id: str) -> None:
        if run_id in self._stopped:
            raise JobStoppedError(run_id)

    def is_running(self, run_id: str) -> bool:
        return self._running[run_id] > 0


_ATTEMPTS = _Attempts()


def examine(ticket: dict[str, Any], dask_worker: Any) -> str | None:  # noqa: ANN401 - the Dask worker, by its name
    """Return why this worker cannot take part, None if it can; called on each worker before it gets a job."""
    if (found := difference(ticket["identity"])) is not None:
        return found
    if dask_worker.state.nthreads != 1:
        return f"has {dask_worker.state.nthreads} threads; start it with --nthreads 1, and more of them by --nworkers"
    if not (Path(ticket["staging"]) / MARKER).exists():
        return f"does not find {ticket['staging']}; the output folder has to be on a file system that all share"
    return None


def run_job(ticket: dict[str, Any], position: int, payload: bytes) -> JobDone | JobRefused:
    """Do one job in a folder of this attempt; the folder is removed if the job does not finish."""
    from distributed import get_worker

    dask_worker = get_worker()
    if (refusal := examine(ticket, dask_worker)) is not None:
        raise WorkerRefusedError(refusal)
    run_id = ticket["run"]
    folder = Path(ticket["staging"]) / f"{position}-{uuid.uuid4().hex}"

    def report(values: dict[str, int | str]) -> None:
        _ATTEMPTS.check(run_id)
        dask_worker.log_event(ticket["topic"], {"position": position, "folder": folder.name} | values)

    _ATTEMPTS.begin(run_id)
    try:
        folder.mkdir()
        value = pickle.loads(payload).run(folder, report)  # noqa: S301 - the client may run anything # nosec B301
        files = tuple(sorted(_written(folder)))
        return JobDone(folder=folder.name, files=files, value=value)
    except Exception as error:
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, (JobStoppedError, MemoryError)):
            raise
        return JobRefused(reason=f"worker {_name(dask_worker)} {error}")
    finally:
        _ATTEMPTS.end(run_id)


def _written(folder: Path) -> list[str]:
    """Return the files that the job wrote; a link is an input."""
    return [str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]


def _name(dask_worker: Any) -> str:  # noqa: ANN401
    return f"{dask_worker.name} on {socket.gethostname()} ({dask_worker.address})"


async def stop_run(run_id: str) -> bool:
    """Stop the jobs of a run at their next report of progress; return whether they have ended."""
    _ATTEMPTS.stop(run_id)
    for _ in range(int(STOP_WITHIN_S / STOP_STEP_S)):
        if not _ATTEMPTS.is_running(run_id):
            return True
        await asyncio.sleep(STOP_STEP_S)
    return False


class ClusterJob(Protocol):
    """A job that reads by path, writes into the folder it is given, and returns a value that can be pickled."""

    def run(self, folder: Path, report: Report) -> object:
        """Do the work."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasureJob:
    """A recording to measure; ``recording_bytes`` is its size as the client sees it, None if the client does not."""

    task: FileTask
    recording_bytes: int | None

    def run(self, folder: Path, report: Report) -> FileOutcome:
        """Measure; errors of recording and calibration are part of the outcome."""
        for path in (self.task.recording, self.task.calibration):
            if not path.exists():
                raise RecordingError(f"does not find {path}")
        size = self.task.recording.stat().st_size
        if self.recording_bytes not in {None, size}:
            raise RecordingError(f"finds another file as {self.task.recording}: {size} bytes, {self.recording_bytes}")

        def on_progress(progress: Progress) -> None:
            report({"frames": progress.frames, "total": progress.total})

        return measure_file(replace(self.task, out=folder), on_progress)
