"""Wait for a condition that another thread or process brings about: the one place where tests poll."""

import time
from collections.abc import Callable


def eventually(
    condition: Callable[[], object],
    *,
    within_s: float = 5.0,
    pause_s: float = 0.005,
    detail: Callable[[], object] = lambda: "that did not happen in time",
) -> None:
    """Return as soon as the condition is true; fail with the detail after ``within_s`` seconds.

    The condition may assert what must hold meanwhile, such as that a process still runs.
    """
    end_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end_s, detail()
        time.sleep(pause_s)
