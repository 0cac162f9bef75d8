"""The rules that a camera and a beam line of your own must pass, as classes of tests for pytest.

>>> class TestMine(tidegate.testing.CameraRules):
...     driver = MyDriver()
"""

import time
from collections.abc import Iterator

import numpy as np
import pytest

from engine.capture.source import CameraDriver, LiveSource
from engine.core.clock import MonotonicClock
from engine.core.errors import FrameTimeoutError, SourceLostError
from engine.core.frames import RgbdFrame
from tidegate.plug_ins import Wire

FRAMES = 60
FIRST_S = 10.0
NEXT_S = 2.0
SETTLE_S = 2.0
WITHIN_S = 0.5
CLOCKS_APART = 0.02
DROP_S = 1.0
"""A receiver drops the permit when no heartbeat has come for this long."""


class CameraRules:
    """Rules of delivery, on the first camera of ``driver``: connect it, and let it look at something that stands."""

    driver: CameraDriver

    @pytest.fixture
    def source(self) -> Iterator[LiveSource]:
        """Open the first camera."""
        found = self.driver.camera(None, clock=MonotonicClock())
        found.open()
        yield found
        found.close()
        found.close()  # safe to call twice

    def read(self, source: LiveSource, count: int = FRAMES) -> list[RgbdFrame]:
        """Read frames."""
        return [source.read(NEXT_S if index else FIRST_S) for index in range(count)]

    def read_at_once(self, source: LiveSource) -> None:
        """Read frames faster than any camera has them."""
        for _ in range(FRAMES):
            source.read(0.001)

    def test_addresses_are_listed_with_the_prefix(self) -> None:
        """An address names its driver."""
        found = [one.uri for one in self.driver.list_cameras()]
        assert found, f"{self.driver.label} lists no camera"
        assert all(uri.startswith(self.driver.prefix) for uri in found)
        assert len(set(found)) == len(found)

    def test_an_unknown_address_is_refused(self) -> None:
        """Only listed addresses are opened: an SDK may open a file just as well."""
        with pytest.raises(SourceLostError):
            self.driver.camera(f"{self.driver.prefix}/etc/passwd", clock=MonotonicClock()).open()

    def test_frames_have_the_sizes_that_were_described(self) -> None:
        """Depth is millimetres."""
        source = self.driver.camera(None, clock=MonotonicClock())
        described = source.open()
        try:
            frame = self.read(source, 1)[0]
        finally:
            source.close()
        assert frame.depth_mm.shape == described.depth_size[::-1]
        assert frame.color.shape[:2] == described.color_size[::-1]
        assert described.is_live
        seen = frame.depth_mm[frame.depth_mm > 0]
        assert 200.0 < np.median(seen) < 5_000.0, "depth in millimetres, of something between 0.2 and 5 m"

    def test_no_frame_is_lost_silently(self, source: LiveSource) -> None:
        """Ordinals have no gap; a step of the device's counter is counted as missed."""
        frames = self.read(source)
        assert [frame.index for frame in frames] == list(range(FRAMES))
        steps = np.diff([frame.device_index for frame in frames])
        assert (steps >= 1).all()
        assert [frame.missed_frames for frame in frames[1:]] == (steps - 1).tolist()

    def test_times_go_on_at_one_rate(self, source: LiveSource) -> None:
        """The device's clock and the host's agree within 2 %, and neither stands still nor goes back."""
        frames = self.read(source)
        device_us = np.array([frame.timestamp_us for frame in frames])
        host_us = np.array([frame.received_ns for frame in frames]) / 1000.0
        assert (np.diff(device_us) > 0).all()
        assert (np.diff(host_us) > 0).all()
        assert abs(np.polyfit(device_us, host_us, 1)[0] - 1.0) < CLOCKS_APART

    def test_each_frame_has_its_own_pictures(self, source: LiveSource) -> None:
        """A buffer that the SDK writes again would change a frame that is being measured."""
        frames = self.read(source, 5)
        kept = [frame.depth_mm.copy() for frame in frames]
        self.read(source, 5)
        assert all(np.array_equal(frame.depth_mm, copy) for frame, copy in zip(frames, kept, strict=True))

    def test_nothing_waits_in_the_driver(self, source: LiveSource) -> None:
        """When the queue was last empty is evidence of a frame's age: the gate needs it of a live camera."""
        time.sleep(SETTLE_S / 4)
        for frame in self.read(source)[-FRAMES // 2 :]:
            assert frame.queue_empty_ns is not None
            assert frame.queue_empty_ns <= frame.received_ns

    def test_a_read_ends_in_time(self, source: LiveSource) -> None:
        """A frame that is not there is a time-out, after which the camera is still usable."""
        self.read(source, 2)
        with pytest.raises(FrameTimeoutError):
            self.read_at_once(source)
        self.read(source, 2)

    def test_it_opens_again(self, source: LiveSource) -> None:
        """The device is released when it is closed."""
        source.close()
        again = self.driver.camera(None, clock=MonotonicClock())
        again.open()
        try:
            assert self.read(again, 1)[0].index == 0
        finally:
            again.close()
            assert again.is_free


class WireRules:
    """Drills of a beam line, on the hardware that ``make`` connects to: nothing may be treated meanwhile."""

    def make(self) -> Wire:
        """Return the wire, not connected."""
        raise NotImplementedError

    @pytest.fixture
    def wire(self) -> Iterator[Wire]:
        """Connect, and leave it off."""
        found = self.make()
        found.connect()
        self.exchange(found, is_on=False, count=1)
        yield found
        found.exchange(is_on=False, heartbeat=0, within_s=WITHIN_S)
        found.close()
        found.close()  # safe to call twice

    def exchange(self, wire: Wire, *, is_on: bool, count: int = 200) -> bool:
        """Exchange until the line reads back what is commanded; return the last read-back."""
        reads = not is_on
        for heartbeat in range(count):
            reads = wire.exchange(is_on=is_on, heartbeat=heartbeat % 65_536, within_s=WITHIN_S)
            if reads is is_on:
                break
            time.sleep(SETTLE_S / count)
        return reads

    def test_it_has_a_name(self, wire: Wire) -> None:
        """For messages."""
        assert wire.name

    def test_off_reads_back_off(self, wire: Wire) -> None:
        """Also where nothing was ever permitted."""
        assert self.exchange(wire, is_on=False) is False

    def test_on_reads_back_on_and_off_again(self, wire: Wire) -> None:
        """The read-back is the contact's, not an echo of the command."""
        assert self.exchange(wire, is_on=True) is True
        assert self.exchange(wire, is_on=False) is False

    def test_a_permit_without_heartbeats_is_dropped(self, wire: Wire) -> None:
        """A process that is killed leaves no beam on: the receiver drops the permit by itself."""
        assert self.exchange(wire, is_on=True) is True
        time.sleep(2.0 * DROP_S)
        again = self.make()
        again.connect()
        try:
            assert self.exchange(again, is_on=False, count=1) is False
        finally:
            again.close()

    def test_an_answer_comes_in_time_or_fails(self, wire: Wire) -> None:
        """An exchange ends within its time-out."""
        began = time.monotonic()
        wire.exchange(is_on=False, heartbeat=1, within_s=WITHIN_S)
        assert time.monotonic() - began < 2.0 * WITHIN_S

    def test_it_connects_again(self, wire: Wire) -> None:
        """As after a cable that was pulled."""
        wire.close()
        wire.connect()
        assert self.exchange(wire, is_on=False) is False
