"""Signals during a run that permits a beam."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interruptible() -> Iterator[None]:
    """Handle SIGTERM and SIGINT as Ctrl-C: the line is held and the run recorded before the process ends.

    SIGINT explicitly too: a shell starts background processes with it ignored, and this process permits a beam.
    """

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
