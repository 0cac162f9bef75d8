"""A process that looks at the time, and notes when this machine did not let it.

Run: ``python -m tests.support.scheduling_monitor``.

A line off late on a machine that stood still says nothing of Tidegate. Such a trial is done again, and counted.
"""

import os
import subprocess
import sys
import threading
import time
from collections import deque

from engine.core.clock import NS_PER_MS
from tests.support.repository import ROOT

STEP_S = 0.002
WORTH_TELLING_NS = 10 * NS_PER_MS
KEPT = 4096


class Watchman:
    """The monitoring process, and the stalls it reported."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.support.scheduling_monitor"], cwd=ROOT, stdout=subprocess.PIPE, text=True
        )
        self._stalls: deque[tuple[int, int]] = deque(maxlen=KEPT)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        return self._process.pid

    def stalled_ms(self, from_ns: int, to_ns: int) -> float:
        """How much of this time the machine stood still [ms]; less than 10 ms on end do not count."""
        overlaps = (min(end, to_ns) - max(begin, from_ns) for begin, end in list(self._stalls))
        return sum(overlap for overlap in overlaps if overlap > 0) / NS_PER_MS

    def end(self) -> None:
        self._process.kill()
        self._process.wait()
        self._reader.join()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            begin, end = line.split()
            self._stalls.append((int(begin), int(end)))


def main() -> None:
    last_ns, parent = time.monotonic_ns(), os.getppid()
    while os.getppid() == parent:  # ends with its parent
        time.sleep(STEP_S)
        now_ns = time.monotonic_ns()
        if now_ns - last_ns > WORTH_TELLING_NS:
            sys.stdout.write(f"{last_ns} {now_ns}\n")
            sys.stdout.flush()
        last_ns = now_ns


if __name__ == "__main__":
    main()
