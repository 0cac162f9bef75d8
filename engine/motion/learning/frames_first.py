"""Lets a frame that is being measured go before a training job in another thread.

Both need the interpreter's lock. A thread that waits for it takes it after a switch interval, so that a frame which
gives it away at a native call waits that long to have it back, each time. A job therefore pauses between its steps
while a frame is being measured: what a frame waits for is one step at most.
"""

import threading
from types import TracebackType

LONGEST_PAUSE_S = 0.05
"""More than a frame takes; a job continues beside a measurement that hangs."""


class FramesFirst:
    """Entered for each frame by the thread that measures; jobs call `give_way` between their steps."""

    def __init__(self) -> None:
        self._is_free = threading.Event()
        self._is_free.set()
        self._measuring: int | None = None

    def __deepcopy__(self, _known: dict[int, object]) -> "FramesFirst":
        """Return one of its own: a copied pipeline measures its own frames."""
        return FramesFirst()

    def __enter__(self) -> None:
        """Have the jobs of other threads pause."""
        self._measuring = threading.get_ident()
        self._is_free.clear()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Let them continue."""
        self._is_free.set()

    def give_way(self) -> None:
        """Wait until no frame is being measured; a job in the measuring thread itself does not wait."""
        if self._measuring != threading.get_ident():
            self._is_free.wait(LONGEST_PAUSE_S)
