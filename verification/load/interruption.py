"""What Ctrl-C and SIGTERM do to a run: it ends early, and tells what it has; at once where that is nothing yet."""

import contextlib
import signal
import time
from collections.abc import Iterator

LOOK_S = 0.1


class Ending:
    """Whether somebody asked for the end; a second time, or before anything is measured, all is left at once."""

    def __init__(self) -> None:
        self.is_asked = False
        self._is_measuring = False

    def measuring(self) -> None:
        """Say that from now on there is something to tell."""
        self._is_measuring = True

    def handle(self, *_: object) -> None:
        """Be asked.

        Raises
        ------
        KeyboardInterrupt
            There is nothing to report, or it is the second request.
        """
        if self.is_asked or not self._is_measuring:
            raise KeyboardInterrupt
        self.is_asked = True

    def sleep(self, seconds: float) -> None:
        """Sleep so long, or until somebody asks."""
        end_s = time.monotonic() + seconds
        while not self.is_asked and (left_s := end_s - time.monotonic()) > 0.0:
            time.sleep(min(left_s, LOOK_S))

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Handle both signals until the block ends, even if the parent process had them ignored."""
        kept = {number: signal.signal(number, self.handle) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in kept.items():
                signal.signal(number, handler)
