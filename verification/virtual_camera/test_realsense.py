"""RealSense cameras: librealsense's software device, in the camera's process, as the product's own source meets it."""

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from engine.calibration import load_calibration
from engine.calibration.device_registration import built_in_calibration
from engine.capture import CameraOptions, OniFileSource, describe
from engine.capture.drivers import list_cameras, listed_address, open_camera
from engine.core.clock import MonotonicClock
from engine.core.errors import FrameTimeoutError, RuntimeMissingError, SourceLostError
from engine.core.frames import Markers
from engine.motion.stages.markers import MarkerSearch, find_markers
from tests.support.capture.sdk_cameras import frames, until_lost
from tests.support.realsense.camera import SERIAL, URI, cable, environment, settings
from tests.support.waiting import eventually

pytestmark = pytest.mark.alone


@pytest.fixture
def seen(camera, monkeypatch):
    """Let this process see the virtual camera as a RealSense with these faults; returns what does so."""

    def see(**faults):
        for name, value in environment(camera, **faults).items():
            monkeypatch.setenv(name, value)
        monkeypatch.delenv("OPENNI2_REDIST", raising=False)
        return open_camera(URI, clock=MonotonicClock())

    return see


def until_silent(source):
    while True:
        source.read(0.5)


def test_it_is_listed_by_its_serial_number(seen):
    seen()
    (one,) = list_cameras("realsense:")
    assert (one.uri, one.name) == (URI, "Virtual D435")
    assert listed_address(None, "realsense:") == URI


def test_a_camera_with_infrared_pictures_is_listed_a_second_time_and_a_room_may_be_pinned_to_either(seen):
    seen(infrared=True)
    assert [(one.uri, one.name) for one in list_cameras("realsense:")] == [
        (URI, "Virtual D435"),
        (f"{URI}/infrared", "Virtual D435, infrared"),
    ]
    assert listed_address(None, URI) == URI
    assert listed_address(None, f"{URI}/infrared") == f"{URI}/infrared"
    with pytest.raises(SourceLostError, match="beginning of 2 cameras"):
        listed_address(None, "realsense:")


def test_the_infrared_picture_comes_from_the_sensor_of_depth_in_its_own_view(camera, seen):
    seen(infrared=True)
    address = f"{URI}/infrared"
    known = built_in_calibration(address)
    assert known.color == known.depth
    assert np.abs(known.color_from_depth.translation_mm).max() == 0.0
    source = open_camera(address, clock=MonotonicClock())
    described = source.open()
    try:
        found = frames(source, 10)
    finally:
        source.close()
    assert described.name == "Virtual D435, infrared, firmware 5.16.0.1"
    assert described.color_size == described.depth_size == (640, 480)
    for one in found:
        assert one.color_timestamp_us == one.timestamp_us
        assert (one.color == one.color[..., :1]).all()
    search = MarkerSearch(diameter_px=20.0 * known.depth.fx / 850.0, superior_px=(0.0, -1.0))
    markers = find_markers(found[-1].color, search)
    assert isinstance(markers, Markers)
    truth = load_calibration(camera.film.calibration_path)
    in_color = find_markers(camera.film.pictures(0)[1], replace(search, diameter_px=20.0 * truth.color.fx / 850.0))
    depth_mm = camera.film.pictures(0)[0]
    for at, beside in zip(markers.centers_px, in_color.centers_px, strict=True):
        column, row = np.rint(at).astype(int)
        near = depth_mm[row - 12 : row + 13, column - 12 : column + 13]
        point = truth.depth.rays(at[None]) * float(np.median(near[near > 0]))
        assert truth.color.project(truth.color_from_depth.apply(point))[0] == pytest.approx(beside, abs=4.0)


def test_what_the_site_sets_is_set_before_the_start_and_stays(camera, seen):
    seen(options=True)
    chosen = CameraOptions(preset="high-accuracy", exposure_us=6000, laser_percent=50.0)
    source = open_camera(URI, clock=MonotonicClock(), options=chosen)
    source.open()
    try:
        assert len(frames(source, 3)) == 3
    finally:
        source.close()
    asked = {"visual_preset": 3.0, "enable_auto_exposure": 0.0, "exposure": 6000.0, "laser_power": 180.0}
    assert settings(camera) == {"start": asked, "stop": asked}


def test_the_exposure_that_was_found_in_the_first_second_is_kept(camera, seen):
    source = seen(options=True)
    source.open()
    source.close()
    noted = settings(camera)
    assert (noted["start"]["enable_auto_exposure"], noted["stop"]["enable_auto_exposure"]) == (1.0, 0.0)
    assert noted["stop"]["exposure"] == noted["start"]["exposure"] == 8500.0


@pytest.mark.parametrize(
    ("has_options", "options", "words"),
    [
        (True, {"preset": "best"}, "camera.depth_preset is best: this camera has .*high-accuracy"),
        (True, {"exposure_us": 170_000}, "exposure cannot be 170000"),
        (False, {"preset": "high-accuracy"}, "no visual preset: camera.depth_preset cannot be set"),
        (False, {"exposure_us": 6000}, "no exposure: camera.depth_exposure_us cannot be set"),
        (False, {"laser_percent": 50.0}, "no laser power: camera.laser_percent cannot be set"),
    ],
)
def test_what_a_camera_cannot_be_set_to_is_refused_by_the_setting_s_name(seen, has_options, options, words):
    seen(options=has_options)
    source = open_camera(URI, clock=MonotonicClock(), options=CameraOptions(**options))
    with pytest.raises(SourceLostError, match=words):
        source.open()


def test_frames_are_the_films_in_mm_with_the_devices_times_and_numbers(camera, seen):
    source = seen()
    described = source.open()
    try:
        assert (described.kind, described.serial, described.is_live) == ("realsense", SERIAL, True)
        assert described.name == "Virtual D435, firmware 5.16.0.1"
        found = frames(source, 20)
    finally:
        source.close()
    assert [one.index for one in found] == list(range(20))
    for one, two in pairwise(found):
        assert 1 <= two.device_index - one.device_index <= 1 + two.missed_frames
        assert two.timestamp_us - one.timestamp_us == pytest.approx(33_367 * (1 + two.missed_frames), abs=200)
        assert one.received_ns < two.received_ns
    films = [camera.film.pictures(i)[0] for i in range(camera.film.frames)]
    assert all(any(np.array_equal(one.depth_mm, film) for film in films) for one in found[:3])
    assert found[0].color.shape == (480, 640, 3)
    away = [one.color_timestamp_us - one.timestamp_us for one in found]
    assert max(map(abs, away)) < 200_000, away


def test_a_camera_with_a_finer_unit_gives_mm(seen):
    source = seen(unit_m=0.0001)
    source.open()
    try:
        (frame,) = frames(source, 1)
    finally:
        source.close()
    known = frame.depth_mm[frame.depth_mm > 0]
    assert 700 < np.median(known) < 1300


def test_a_clock_that_wraps_at_2_to_the_32_us_goes_on(seen):
    source = seen(clock_us=2**32 - 61_500_000)  # its clock shows a minute when it is opened
    source.open()
    try:
        found = frames(source, 90)
    finally:
        source.close()
    times = [one.timestamp_us for one in found]
    assert times[0] < 2**32 < times[-1]
    steps = [two - one for one, two in pairwise(times)]
    assert min(steps) > 20_000, steps
    assert max(steps) < 2_000_000, steps
    away = [one.color_timestamp_us - one.timestamp_us for one in found]
    assert max(map(abs, away)) < 200_000, away


REFUSED = {
    "a slow connection": ({"usb": "2.1"}, "USB 2.1: it needs a USB 3 port"),
    "another program": ({"busy": True}, "Device or resource busy"),
    "no times of its own": ({"domain": "system_time"}, "delivers no times of its own"),
    "the SDK's global time": ({"domain": "global_time"}, "delivers no times of its own"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_measured_with_is_refused_with_its_cause(seen, name):
    faults, words = REFUSED[name]
    source = seen(**faults)
    with pytest.raises(SourceLostError, match=words):
        source.open()
    assert source.is_free


def test_another_serial_number_is_not_opened(seen, monkeypatch):
    seen(serial="999")
    with pytest.raises(SourceLostError, match=f"no RealSense camera {SERIAL}"):
        open_camera(URI, clock=MonotonicClock()).open()


def test_a_stop_that_hangs_does_not_hang_the_engine(seen):
    source = seen(hangs="stop")
    source.open()
    frames(source, 3)
    before_s = time.monotonic()
    source.close()
    assert time.monotonic() - before_s < 10.0
    assert source.is_free


def test_a_process_that_is_killed_is_a_lost_camera(seen):
    source = seen()
    source.open()
    frames(source, 2)
    os.kill(source.process_id, 9)
    with pytest.raises(SourceLostError, match="signal 9"):
        frames(source, 100)
    source.close()
    source.open()
    frames(source, 2)
    source.close()


def test_an_sdk_that_does_not_answer_is_reported(seen, monkeypatch):
    seen(hangs="query")
    monkeypatch.setattr("engine.capture.camera_process.source.LIST_S", 2.0)
    with pytest.raises(RuntimeMissingError, match="does not answer"):
        list_cameras("realsense:")


def test_lost_frames_are_counted_and_silence_is_silence(camera, seen):
    source = seen()
    source.open()
    try:
        frames(source, 3)
        camera.skip(5)
        found = frames(source, 15)
        assert sum(one.missed_frames for one in found) >= 5
        receipt = camera.stall()
        with pytest.raises(FrameTimeoutError):
            until_silent(source)
        camera.undo(receipt)
        frames(source, 3)
    finally:
        source.close()


def test_an_unplugged_camera_is_lost_and_is_found_again(camera, seen):
    source = seen()
    source.open()
    frames(source, 3)
    cable(camera).unlink()
    with pytest.raises(SourceLostError, match="disconnected"):
        until_lost(source)
    assert list_cameras("realsense:") == []
    source.close()
    cable(camera).touch()
    eventually(lambda: list_cameras("realsense:") != [], detail=lambda: "it does not come back")


def test_frames_that_are_not_taken_are_counted_and_the_newest_are_kept_in_order(seen):
    source = seen()
    source.open()
    try:
        frames(source, 2)
        time.sleep(1.5)  # more than the ring holds
        found = frames(source, 60)
    finally:
        source.close()
    numbers = [one.device_index for one in found]
    assert numbers == sorted(numbers)
    assert max(one.missed_frames for one in found) > 10
    for one, two in pairwise(found):
        assert 1 <= two.device_index - one.device_index <= 1 + two.missed_frames


def test_the_makers_calibration_is_the_cameras(camera, seen):
    seen()
    found = built_in_calibration(URI)
    wanted = camera.film.calibration
    assert (found.camera, found.serial, found.is_built_in) == ("device calibration: Virtual D435", SERIAL, True)
    assert not found.is_device_registration
    for name in ("depth", "color"):
        ours, theirs = getattr(found, name), getattr(wanted, name)
        assert np.allclose(ours.constants, theirs.constants, rtol=1e-5, atol=1e-5)
    assert np.allclose(found.color_from_depth.rotation, wanted.color_from_depth.rotation, atol=1e-6)
    assert np.allclose(found.color_from_depth.translation_mm, wanted.color_from_depth.translation_mm, atol=1e-3)


def run(camera, *words, **faults):
    env = {**os.environ, **environment(camera, **faults)}
    env.pop("OPENNI2_REDIST", None)
    return subprocess.run(
        [sys.executable, "-m", "service.cli", *words], env=env, capture_output=True, text=True, timeout=120, check=False
    )


def test_it_is_recorded_with_every_frame_and_measured_with_its_own_calibration(camera, tmp_path):
    out, calibration = tmp_path / "recording.oni", tmp_path / "calibration.json"
    done = run(camera, "record", "--source", URI, "--seconds", "3", "--out", str(out))
    assert done.returncode == 0, done.stderr
    assert [path.name for path in tmp_path.glob("*.oni*")] == ["recording.oni"]
    source = OniFileSource(out, clock=MonotonicClock())
    source.open()
    first = source.read(1.0)
    source.close()
    assert any(np.array_equal(first.depth_mm, camera.film.pictures(i)[0]) for i in range(camera.film.frames))
    done = run(camera, "devices", "calibration", "--source", URI, "--out", str(calibration))
    assert done.returncode == 0, done.stderr
    found = load_calibration(calibration)
    assert (found.camera, found.serial, found.is_built_in) == ("Virtual D435, by its maker", SERIAL, False)


def test_it_is_listed_and_checked_on_the_command_line(camera, tmp_path):
    listed = run(camera, "devices", "list").stdout
    assert URI in listed
    assert "pip install --no-deps pyorbbecsdk2" in listed
    assert "tidegate[realsense]" in listed
    out = tmp_path / "check.json"
    done = run(camera, "devices", "check", "--source", URI, "--seconds", "6", "--out", str(out), temperature_c=41.5)
    document = json.loads(out.read_text())
    assert document["camera"]["serial"] == SERIAL
    found = {one["code"]: one for one in document["findings"]}
    # A volunteer breathes below it, so that the picture is not still; its times are what is looked at here.
    assert {found[code]["verdict"] for code in ("back", "repeated")} == {"pass"}
    assert {"rate", "missed", "gap", "clock", "jitter", "colour", "holes", "noise_16", "drift"} <= found.keys()
    assert (found["temperature"]["value"], document["curve"][-1]["temperature_c"]) == (41.5, 41.5)
    assert "noise of a pixel" in done.stdout
    assert done.returncode in {0, 1}


def test_a_recording_of_its_sdk_is_read_frame_by_frame_and_has_its_calibration(camera, tmp_path):
    made, out, calibration = tmp_path / "viewer.db3", tmp_path / "recording.oni", tmp_path / "calibration.json"
    env = {**os.environ, **environment(camera)}
    program = [sys.executable, "-m", "tests.support.realsense.recorder_program", str(made), "4"]
    done = subprocess.run(program, env=env, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert made.stat().st_size > 1_000_000
    plain = {name: value for name, value in os.environ.items() if name != "CAMERA_SDK_PATH"}
    command = [sys.executable, "-m", "service.cli"]
    for words in (
        ["record", "--source", str(made), "--seconds", "60", "--out", str(out)],
        ["devices", "calibration", "--source", str(made), "--out", str(calibration)],
    ):
        done = subprocess.run([*command, *words], env=plain, capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stderr
    assert load_calibration(calibration).serial == SERIAL
    found = describe(out)
    assert found.depth.frames > 90
    assert found.depth.missed_frames <= 2
    source = OniFileSource(out, clock=MonotonicClock())
    source.open()
    first = source.read(1.0)
    source.close()
    assert any(np.array_equal(first.depth_mm, camera.film.pictures(i)[0]) for i in range(camera.film.frames))


def test_a_file_of_no_sdk_is_refused(camera, tmp_path):
    (tmp_path / "none.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(5000))
    done = run(camera, "record", "--source", str(tmp_path / "none.bag"), "--out", str(tmp_path / "out.oni"))
    assert done.returncode == 2
    assert "is a recording of neither RealSense's nor Orbbec's SDK" in done.stderr
    assert list(tmp_path.glob("*.oni*")) == []
