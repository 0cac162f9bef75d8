"""How frames of a device are taken, paired and given up on, with a device that a test plays."""

import threading
from collections import deque

import numpy as np
import pytest

from engine.capture.openni.device import COLOR, DEPTH, DeviceFrame
from engine.capture.openni.pump import CapturePump
from engine.core.clock import NS_PER_MS, ManualClock
from engine.core.errors import FrameTimeoutError, SourceEndedError, SourceLostError

pytestmark = pytest.mark.alone

PICTURE = np.zeros((2, 2), np.uint16)


class PlayedDevice:
    """A device whose frames come when the test requests it."""

    def __init__(self):
        self.is_over = False
        self._lost = None
        self._frames = deque()
        self._more = threading.Semaphore(0)
        self.all_taken = threading.Event()

    def give(self, *frames):
        self.all_taken.clear()
        for stream, timestamp_us in frames:
            self._frames.append(DeviceFrame(stream=stream, frame_index=1, timestamp_us=timestamp_us, picture=PICTURE))
            self._more.release()

    def lose(self, why):
        self._lost = why

    def lost(self):
        return self._lost

    def is_silent(self, _timeout_ms):
        raise AssertionError("a file's silence shows nothing")

    def wait(self, timeout_ms):
        if self._more.acquire(timeout=timeout_ms / 1000):
            return self._frames.popleft()
        self.all_taken.set()
        return None


@pytest.fixture
def device():
    return PlayedDevice()


@pytest.fixture
def pump(device):
    pump = CapturePump(device, ManualClock(5))
    pump.start()
    yield pump
    assert pump.stop()


def taken(pump, margin_us=None, timeout_s=5.0):
    depth, color = pump.take(timeout_s, margin_us)
    return depth.frame.timestamp_us, color.frame.timestamp_us


def test_a_live_device_gets_the_nearest_colour_in_hand(device, pump):
    device.give((COLOR, 90), (COLOR, 97), (DEPTH, 100))
    assert taken(pump) == (100, 97)


def test_the_first_depth_frame_waits_for_a_colour_frame(device, pump):
    device.give((DEPTH, 100))
    with pytest.raises(FrameTimeoutError):
        taken(pump, timeout_s=0.05)
    device.give((COLOR, 130))
    assert taken(pump) == (100, 130)


def test_a_file_waits_for_the_colour_that_may_be_nearer(device, pump):
    device.give((COLOR, 80), (DEPTH, 100))
    with pytest.raises(FrameTimeoutError):
        taken(pump, margin_us=12.0, timeout_s=0.05)
    device.give((COLOR, 110))
    assert taken(pump, margin_us=12.0) == (100, 110)


def test_a_file_does_not_wait_where_no_later_colour_can_be_nearer(device, pump):
    device.give((COLOR, 90), (DEPTH, 100))
    assert taken(pump, margin_us=12.0) == (100, 90)


def test_a_file_gives_up_waiting_when_depth_goes_on_without_colour(device, pump):
    device.give((COLOR, 10), (DEPTH, 100), (DEPTH, 133), (DEPTH, 166))
    assert taken(pump, margin_us=12.0) == (100, 10)


def test_after_the_last_colour_frame_of_a_file_none_is_waited_for(device):
    pump = CapturePump(device, ManualClock(5), last_color_us=99)
    pump.start()
    device.give((COLOR, 66), (COLOR, 99), (DEPTH, 100), (DEPTH, 133))
    assert [taken(pump, margin_us=12.0) for _ in range(2)] == [(100, 99), (133, 99)]
    assert not device.is_over, "nothing said yet that the file is over"
    assert pump.stop()


def test_silence_is_a_timeout_and_the_source_stays_usable(device, pump):
    with pytest.raises(FrameTimeoutError):
        taken(pump, timeout_s=0.05)
    device.give((COLOR, 99), (DEPTH, 100))
    assert taken(pump) == (100, 99)


def test_a_device_that_is_gone_is_lost_after_its_last_frames(device, pump):
    device.give((COLOR, 99), (DEPTH, 100))
    assert taken(pump) == (100, 99)
    device.lose("the camera was disconnected")
    with pytest.raises(SourceLostError, match="disconnected"):
        taken(pump)


def test_the_end_of_a_file_comes_after_its_last_frames(device, pump):
    device.is_over = True
    device.give((COLOR, 99), (DEPTH, 100), (DEPTH, 133))
    assert taken(pump, margin_us=12.0) == (100, 99)
    assert taken(pump, margin_us=12.0) == (133, 99)
    with pytest.raises(SourceEndedError):
        taken(pump)


def test_a_long_stall_drops_the_oldest_frames_not_the_newest(device, pump):
    device.give((COLOR, 0), *((DEPTH, 10 * i) for i in range(1, 21)))
    device.all_taken.wait(5.0)
    assert [taken(pump)[0] for _ in range(8)] == [130, 140, 150, 160, 170, 180, 190, 200]
    with pytest.raises(FrameTimeoutError):
        taken(pump, timeout_s=0.05)


def test_threads_that_waited_in_the_runtime_are_used_again_and_never_end(device):
    before = threading.active_count()
    for _ in range(20):
        pump = CapturePump(device, ManualClock())
        pump.start()
        assert pump.stop()
    assert threading.active_count() <= before + 1


def test_a_fault_in_the_capture_thread_is_a_lost_source_and_the_thread_lives(device, caplog):
    device.wait = lambda _timeout_ms: 1 / 0
    pump = CapturePump(device, ManualClock())
    pump.start()
    with pytest.raises(SourceLostError, match="capture has ended"):
        taken(pump)
    assert pump.stop(), "the thread's work is over, its account of it written"
    assert "ZeroDivisionError" in caplog.text
    assert any(thread.name == "openni-capture" for thread in threading.enumerate())


def test_frames_are_stamped_when_they_come(device, pump):
    device.give((COLOR, 99), (DEPTH, 100))
    depth, _ = pump.take(5.0, None)
    assert depth.received_ns == 5


SILENCE_MS = 8


class DriverWithQueue:
    """A driver on a manual clock: each frame becomes ready at its time, and waits until it is read.

    Reading takes 1 ms. A colour frame follows 100 ms after the last. ``oversleeps`` and ``falls_short`` are by how much
    the n-th silence takes longer or shorter than requested [ms].
    """

    is_over = False

    def __init__(self, *ready_ms, oversleeps=None, falls_short=None):
        self.clock = ManualClock()
        self.depths = len(ready_ms)
        self._ready_ns = deque(at_ms * NS_PER_MS for at_ms in (*ready_ms, ready_ms[-1] + 100))
        self._oversleeps, self._falls_short, self._silences = oversleeps or {}, falls_short or {}, 0
        self.done = threading.Event()

    def lost(self):
        if self._ready_ns:
            return None
        self.done.set()
        return "the script is over"

    def is_silent(self, timeout_ms):
        end_ns = self.clock.now_ns() + timeout_ms * NS_PER_MS
        number, self._silences = self._silences, self._silences + 1
        if self._ready_ns[0] < end_ns:
            self._pass_until(self._ready_ns[0] + self._oversleeps.get(number, 0) * NS_PER_MS)
            return False
        self._pass_until(end_ns + (self._oversleeps.get(number, 0) - self._falls_short.get(number, 0)) * NS_PER_MS)
        return True

    def wait(self, timeout_ms):
        self._pass_until(min(self._ready_ns[0], self.clock.now_ns() + timeout_ms * NS_PER_MS))
        if self._ready_ns[0] > self.clock.now_ns():
            return None
        self._ready_ns.popleft()
        self.clock.advance_ns(NS_PER_MS)
        stream = DEPTH if self._ready_ns else COLOR
        return DeviceFrame(stream=stream, frame_index=1, timestamp_us=1, picture=PICTURE)

    def _pass_until(self, at_ns):
        self.clock.advance_ns(max(at_ns - self.clock.now_ns(), 0))


def waited_ms(driver):
    """How long before its receipt each depth frame's queue was last known to be empty [ms]; None where it is not."""
    pump = CapturePump(driver, driver.clock, silence_ms=SILENCE_MS)
    pump.start()
    assert driver.done.wait(10.0)
    assert pump.stop()
    depths = [pump.take(0.0, None)[0] for _ in range(driver.depths)]
    return [
        None if one.queue_empty_ns is None else (one.received_ns - one.queue_empty_ns) / NS_PER_MS for one in depths
    ]


def test_a_frame_that_came_after_a_silence_found_no_frame_waiting():
    assert waited_ms(DriverWithQueue(30, 63, 96)) == [31 - 8, 64 - 39, 97 - 72]


def test_a_driver_that_hands_over_one_frame_after_the_other_was_never_known_to_have_none():
    assert waited_ms(DriverWithQueue(0, 0, 0, 0)) == [None] * 4
    assert waited_ms(DriverWithQueue(5, 10, 15, 20)) == [None] * 4, "each sooner than a silence lasts"


def test_frames_that_waited_while_the_host_was_busy_are_as_old_as_since_the_last_silence_at_most():
    """The thread sleeps for 100 ms too long in the silence after the first frame; three frames come meanwhile."""
    late = waited_ms(DriverWithQueue(30, 63, 96, 129, 162, oversleeps={1: 100}))
    assert late[0] == 23
    assert late[1:4] == [140 - 39, 141 - 39, 142 - 39]
    assert late[4] == 163 - 150, "after the queue has drained"


def test_sleeping_too_long_in_a_read_that_found_a_frame_is_no_silence():
    assert waited_ms(DriverWithQueue(5, 10, 15, oversleeps={0: 500, 1: 500, 2: 500})) == [None] * 3


def test_a_silence_that_was_shorter_than_requested_is_none():
    """The wall clock, by which the runtime waits, was set."""
    assert waited_ms(DriverWithQueue(20, 53, falls_short={0: 3})) == [None, 54 - 29]


def test_a_file_is_played_and_shows_nothing(device, pump):
    device.give((COLOR, 99), (DEPTH, 100))
    depth, _ = pump.take(5.0, None)
    assert depth.queue_empty_ns is None
