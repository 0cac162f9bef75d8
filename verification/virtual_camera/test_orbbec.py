"""Orbbec cameras: the real OrbbecSDK, its own playback as the device, in the camera's process."""

import time
from itertools import pairwise

import numpy as np
import pytest

from engine.calibration.device_registration import built_in_calibration
from engine.capture import CameraOptions, OniFileSource
from engine.capture.drivers import list_cameras, open_camera
from engine.capture.recorder import record
from engine.core.clock import MonotonicClock
from engine.core.errors import SourceLostError
from tests.support.capture.sdk_cameras import frames, until_lost
from tests.support.orbbec.camera import PERIOD_US, SERIAL, URI, environment
from tests.support.virtual_camera.film import baked

pytestmark = pytest.mark.alone


@pytest.fixture(scope="module")
def film():
    return baked()


@pytest.fixture
def seen(film, monkeypatch, tmp_path):
    """Let this process see a recording as a camera; returns what does so."""

    def see(**faults):
        for name, value in environment(tmp_path, film, **faults).items():
            monkeypatch.setenv(name, value)
        return open_camera(URI, clock=MonotonicClock())

    return see


def test_it_is_listed_by_its_serial_number(seen):
    seen()
    (one,) = list_cameras("orbbec:")
    assert (one.uri, one.name) == (URI, "Femto Bolt(Playback)")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"preset": "best"}, "camera.depth_preset is best: this camera has"),
        ({"exposure_us": 6000}, "camera.depth_exposure_us cannot be set"),
        ({"laser_percent": 50.0}, "camera.laser_percent cannot be set"),
    ],
)
def test_what_a_camera_cannot_be_set_to_is_refused_by_the_setting_s_name(seen, options, words):
    seen()
    source = open_camera(URI, clock=MonotonicClock(), options=CameraOptions(**options))
    with pytest.raises(SourceLostError, match=words):
        source.open()


def test_frames_are_the_films_with_the_devices_times_at_its_own_rate(film, seen):
    source = seen()
    described = source.open()
    try:
        found = frames(source, 40)
    finally:
        source.close()
    assert (described.kind, described.serial, described.depth_size) == ("orbbec", SERIAL, (640, 480))
    for one, two in pairwise(found):
        assert two.device_index - one.device_index == 1 + two.missed_frames
        assert two.timestamp_us - one.timestamp_us == PERIOD_US * (1 + two.missed_frames)
    for one in found[:3]:
        depth, _ = film.pictures((one.device_index - 1) % film.frames)
        assert np.array_equal(one.depth_mm, depth)
    assert all(abs(one.color_timestamp_us - one.timestamp_us) < 6 * PERIOD_US for one in found)


def test_lost_frames_are_counted(seen):
    source = seen(change=lambda number, us: None if 30 <= number < 35 else (number, us))
    source.open()
    try:
        found = frames(source, 35)
    finally:
        source.close()
    numbers = [one.device_index for one in found]
    assert not set(numbers) & set(range(30, 35))
    assert next(one for one in found if one.device_index >= 35).missed_frames >= 5


def test_frames_whose_clock_stands_at_0_are_waited_for(seen):
    source = seen(change=lambda number, us: (number, 0 if number < 20 else us))
    source.open()
    try:
        first = source.read(5.0)
    finally:
        source.close()
    assert first.device_index >= 20
    assert first.timestamp_us > 0


REFUSED = {
    "a clock that never runs": ({"change": lambda number, _us: (number, 0)}, "with a time of its own within"),
    "a slow connection": ({"connection": "USB2.1"}, "connected by USB2.1"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_measured_with_is_refused_with_its_cause(seen, name):
    faults, words = REFUSED[name]
    source = seen(**faults, count=200)
    with pytest.raises(SourceLostError, match=words):
        source.open()
    assert source.is_free


def test_a_clock_that_goes_back_is_delivered_for_the_gate_to_judge(seen):
    source = seen(change=lambda number, us: (number, us if number < 30 else us - 700_000))
    source.open()
    try:
        found = frames(source, 40)
    finally:
        source.close()
    assert any(two.timestamp_us < one.timestamp_us for one, two in pairwise(found))


def test_a_stop_that_hangs_does_not_hang_the_engine(seen):
    source = seen(hangs="stop")
    source.open()
    frames(source, 3)
    before_s = time.monotonic()
    source.close()
    assert time.monotonic() - before_s < 10.0
    assert source.is_free


def test_an_unplugged_camera_is_lost(seen, tmp_path):
    source = seen()
    source.open()
    frames(source, 3)
    (tmp_path / "cable").unlink()
    with pytest.raises(SourceLostError, match="disconnected"):
        until_lost(source)
    assert list_cameras("orbbec:") == []
    source.close()


def test_the_makers_calibration_is_the_cameras(film, seen):
    seen()
    found, wanted = built_in_calibration(URI), film.calibration
    assert found.camera.startswith("device calibration: Orbbec Femto Bolt")
    assert (found.serial, found.is_built_in, found.is_device_registration) == (SERIAL, True, False)
    for name in ("depth", "color"):
        assert np.allclose(getattr(found, name).constants, getattr(wanted, name).constants, rtol=1e-5, atol=1e-4)
    assert np.allclose(found.color_from_depth.rotation, wanted.color_from_depth.rotation, atol=1e-6)
    assert np.allclose(found.color_from_depth.translation_mm, wanted.color_from_depth.translation_mm, atol=1e-3)


def test_a_recording_of_its_sdk_is_read_frame_by_frame_and_ends(film, tmp_path):
    environment(tmp_path, film, 60)
    out = tmp_path / "recording.oni"
    found = record(tmp_path / "camera.bag", out, seconds=60.0, clock=MonotonicClock())
    assert (found.depth.frames, found.depth.missed_frames) == (60, 0)
    source = OniFileSource(out, clock=MonotonicClock())
    source.open()
    first = source.read(1.0)
    source.close()
    assert np.array_equal(first.depth_mm, film.pictures(0)[0])
