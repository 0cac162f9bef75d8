"""A recording played four times as fast as it was taken: quick, and slow enough for a person who acts over HTTP."""

import threading
import time

from engine.capture.recording_source import OniFileSource

FASTEST_S = 1.0 / 120.0
WAITING_S = 0.1
"""Between two frames while a model is learned, which takes seconds of a busy machine: the recording must outlast it."""


class HurriedSource(OniFileSource):
    """Frames as soon as they are asked for, but no more than 120 a second, whatever the machine could do.

    Attributes
    ----------
    is_learning
        Set while a model is learned, by the program that can tell.
    """

    is_learning = threading.Event()

    def __init__(self, path, *, clock):
        super().__init__(path, clock=clock, is_paced=False)
        self._due = 0.0

    def read(self, timeout_s):
        time.sleep(max(0.0, self._due - time.monotonic()))
        self._due = time.monotonic() + (WAITING_S if self.is_learning.is_set() else FASTEST_S)
        return super().read(timeout_s)
