"""A camera that a test unplugs, plugs in again, or replaces by another one, and the source that searches for it."""

import threading

import numpy as np
import pytest

from engine.capture.reconnecting import ReturningSource
from engine.capture.source import SourceDescription
from engine.core.clock import NS_PER_MS, ManualClock
from engine.core.errors import FrameTimeoutError, SourceAwayError, SourceLostError
from engine.core.frames import RgbdFrame

PERIOD_NS = 33 * NS_PER_MS
OURS = SourceDescription(
    kind="openni", name="Xtion", depth_size=(4, 3), color_size=(4, 3), fps=30.0, is_live=True, serial="A1"
)
PATIENCE_S = 10.0


class FakeCamera:
    """Delivers frames while it is plugged in; its numbers and times begin anew with each opening."""

    def __init__(self, room):
        self.room, self.frames, self.closed = room, 0, 0

    @property
    def is_free(self):
        return not self.room.hangs

    def open(self):
        if not self.room.is_plugged:
            raise SourceLostError("no camera")
        return self.room.described

    def read(self, _timeout_s):
        if not self.room.is_plugged:
            raise SourceLostError("unplugged")
        if self.room.is_silent:
            raise FrameTimeoutError("nothing came")
        self.room.clock.advance_ns(PERIOD_NS)
        self.frames += 1
        device_us = 33_000 * self.frames - self.room.behind_us
        return RgbdFrame(
            index=self.frames - 1,
            device_index=self.frames,
            missed_frames=0,
            timestamp_us=1_000 + device_us,
            color_timestamp_us=500 + device_us,
            received_ns=self.room.clock.now_ns() + self.room.late_ns,
            depth_mm=np.zeros((3, 4), np.uint16),
            color=np.zeros((3, 4, 3), np.uint8),
        )

    def close(self):
        self.closed += 1


class Room:
    """Where the camera is; searching steps on when the test lets it."""

    def __init__(self, *, needs_serial=True):
        self.clock = ManualClock(1_000_000_000)
        self.is_plugged, self.is_silent, self.described, self.hangs = True, False, OURS, False
        self.behind_us, self.late_ns = 0, 0
        self.made = []
        self.looks = threading.Semaphore(0)
        self.source = ReturningSource(self.make, self.clock, needs_serial=needs_serial, wait=self.wait)

    def make(self):
        self.made.append(FakeCamera(self))
        return self.made[-1]

    def wait(self, stop, _seconds):
        while not self.looks.acquire(timeout=0.01):
            if stop.is_set():
                return True
        return stop.is_set()

    def until_back(self):
        """Let it look until a frame comes."""
        for _ in range(1000):
            self.looks.release()
            try:
                return self.source.read(0.05)
            except SourceAwayError:
                continue
        pytest.fail("it never came back")
