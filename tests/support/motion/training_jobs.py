"""Training jobs that fail in every way; module-level values, since another process unpickles them."""

import contextlib
import os
import resource
import signal
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engine.core.errors import TrainingRefusedError
from tests.support.waiting import eventually

STEP_S = 0.005


@dataclass(frozen=True)
class Returned:
    """Returns its value."""

    value: object

    def __call__(self):
        return self.value


@dataclass(frozen=True)
class Held:
    """Writes its process id to a file and waits until that file is removed; its process may be stopped there."""

    marker: Path
    is_stopped: bool = False

    def __call__(self):
        draft = self.marker.with_suffix(".draft")
        draft.write_text(str(os.getpid()))
        draft.rename(self.marker)
        if self.is_stopped:
            os.kill(os.getpid(), signal.SIGSTOP)
        while self.marker.exists():
            time.sleep(STEP_S)
        return "released"

    def process_id(self):
        """Wait until the job runs, and return its process id."""
        eventually(self.marker.exists)
        return int(self.marker.read_text())


@dataclass(frozen=True)
class Killed:
    """Kills its own process."""

    number: signal.Signals = signal.SIGKILL

    def __call__(self):
        os.kill(os.getpid(), self.number)
        signal.pause()


class Refused:
    """Refuses its frames."""

    def __call__(self):
        raise TrainingRefusedError("training.shift_mm", "9.9", "at most 3", "train again")


class OutOfMemory:
    """Needs more memory than its process may have."""

    def __call__(self):
        resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))
        return np.ones(1 << 31, dtype=np.uint8)


class Unanswerable:
    """Returns what cannot be sent."""

    def __call__(self):
        return threading.Lock()


class StartedBy:
    """Returns the id of the training process."""

    def __call__(self):
        return os.getppid()


class Described:
    """Returns priority, threads, open files and the standing with the kernel's out-of-memory killer of its process."""

    def __call__(self):
        files = {}
        for file in Path("/proc/self/fd").iterdir():
            with contextlib.suppress(OSError):
                files[int(file.name)] = str(file.readlink())
        return {
            "niceness": os.getpriority(os.PRIO_PROCESS, 0),
            "threads": len(list(Path("/proc/self/task").iterdir())),
            "files": files,
            "oom": int(Path("/proc/self/oom_score_adj").read_text()),
        }


def is_running(process_id):
    """Whether a process exists and is not waiting to be reaped."""
    try:
        state = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state not in {"Z", "X"}
