"""Wait for a condition that another thread or process brings about: the one place where tests poll."""

import time
from collections.abc import Callable

PATIENCE_S = 60.0
"""For a machine that gives a test next to no time; it is waited out only where a test fails."""


def eventually(
    condition: Callable[[], object],
    *,
    within_s: float = PATIENCE_S,
    pause_s: float = 0.005,
    detail: Callable[[], object] = lambda: "that did not happen in time",
) -> None:
    """Return as soon as the condition is true; fail with the detail after ``within_s`` seconds.

    A bound of its own is for a test about that time only: a slow machine is no fault.

    The condition may assert what must hold meanwhile, such as that a process still runs.
    """
    end_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end_s, detail()
        time.sleep(pause_s)
