"""The figures of a camera that looks at a still surface: each fault has its own, and a good camera has none."""

from dataclasses import replace

import numpy as np
import pytest

from engine.capture import SourceDescription
from engine.core.frames import RgbdFrame
from engine.core.geometry import Intrinsics
from engine.qa.device_check import DeviceCheck

pytestmark = pytest.mark.verification

SIZE = (128, 128)
DESCRIBED = SourceDescription(
    kind="made up", name="Made up", depth_size=SIZE, color_size=SIZE, fps=30.0, is_live=True, serial="1"
)
FRAMES = 1200


def drum(radius_mm, *, rows, columns, focal_px):
    """Depth of a drum across the picture; of a plane without a radius."""
    depth = np.full((rows, columns), 850.0)
    if radius_mm is None:
        return depth
    across = (np.arange(rows)[:, None] - 0.5 * (rows - 1)) / focal_px + np.zeros(depth.shape)
    for _ in range(80):
        depth = 850.0 + radius_mm - np.sqrt(np.maximum(radius_mm**2 - np.square(across * depth), 0.0))
    return depth


def findings(*, noise_mm=1.0, drift_mm=0.0, **faults):
    """Figures of so many frames; ``ppm``, ``lost``, ``back``, ``repeated``, ``late_ms``, ``holes`` and ``lag_us``."""
    rng = np.random.default_rng(5)
    checked = DeviceCheck(described=DESCRIBED)
    picture = None
    for i in range(FRAMES):
        lost = 10 if i == faults.get("lost") else 0
        number = i + (10 if faults.get("lost") is not None and i >= faults["lost"] else 0)
        time_us = round(number * 1e6 / 30.0)
        host_us = time_us * (1.0 + 1e-6 * faults.get("ppm", 0.0))
        late_us = 1000.0 * faults.get("late_ms", 0.0) if i % 10 == 0 else 0.0
        if picture is None or i != faults.get("repeated"):
            depth = 850.0 + drift_mm * i / FRAMES + rng.normal(0.0, noise_mm, SIZE[::-1])
            picture = np.rint(depth)
            picture[rng.random(picture.shape) < faults.get("holes", 0.0)] = 0
        frame = RgbdFrame(
            index=i,
            device_index=number,
            missed_frames=lost,
            timestamp_us=time_us - (50_000 if i == faults.get("back") else 0),
            color_timestamp_us=time_us + faults.get("lag_us", 11_000),
            received_ns=round(1000.0 * (host_us + late_us)),
            queue_empty_ns=None,
            depth_mm=picture.astype(np.uint16),
            color=np.zeros((*SIZE[::-1], 3), np.uint8),
        )
        warms_c = faults.get("warms_c")
        checked.add(frame, None if warms_c is None else 40.0 + warms_c * i / FRAMES)
    return {one.code: one for one in checked.findings()} | {"curve": checked.curve()}


def test_a_good_camera_passes_and_its_noise_is_the_true_one():
    found = findings()
    del found["curve"]
    assert {one.code for one in found.values() if one.verdict != "pass"} == set()
    assert found["rate"].value == pytest.approx(0.0, abs=0.03)
    assert found["distance"].value == pytest.approx(850.0, abs=0.5)
    assert found["noise_1"].value == pytest.approx(1.0, rel=0.35)  # whole millimetres
    assert found["noise_4"].value == pytest.approx(0.25, rel=0.15)
    assert found["colour"].value == pytest.approx(11.0)


FAULTS = {
    "missed": ({"lost": 300}, "warn"),
    "gap": ({"lost": 300}, "fail"),
    "back": ({"back": 300}, "fail"),
    "clock": ({"ppm": 500.0}, "warn"),
    "jitter": ({"late_ms": 60.0}, "fail"),
    "repeated": ({"repeated": 300}, "fail"),
    "holes": ({"holes": 0.5}, "fail"),
    "noise_1": ({"noise_mm": 9.0}, "fail"),
    "drift": ({"drift_mm": 4.0}, "fail"),
    "colour": ({"lag_us": 150_000}, "fail"),
}


@pytest.mark.parametrize("code", FAULTS)
def test_each_fault_is_found_in_its_own_figure(code):
    faults, verdict = FAULTS[code]
    found = findings(**faults)
    assert found[code].verdict == verdict, found[code]


def test_the_clock_and_the_drift_have_their_amount():
    assert findings(ppm=-300.0)["clock"].value == pytest.approx(-300.0, abs=2.0)
    assert findings(drift_mm=3.0)["drift"].value == pytest.approx(
        2.25, abs=0.3
    )  # between the means of two spans of 10 s


@pytest.mark.parametrize(("radius_mm", "code"), [(None, "flatness"), (150.0, "radius")])
def test_a_surface_of_known_shape_is_judged_by_it(radius_mm, code):
    def verdict(drum_mm):
        found = shape_findings(radius_mm, drum(drum_mm, rows=480, columns=640, focal_px=575.0))
        return found[code].verdict

    assert (verdict(radius_mm), verdict(180.0)) == ("pass", "fail")
    assert "flatness" not in findings()


def shape_findings(radius_mm, depth_mm):
    size = depth_mm.shape[::-1]
    depth = Intrinsics(width=640, height=480, fx=575.0, fy=575.0, cx=319.5, cy=239.5)
    described = replace(DESCRIBED, depth_size=size, color_size=size)
    checked = DeviceCheck(described=described, depth=depth, radius_mm=radius_mm)
    rng = np.random.default_rng(3)
    for i in range(100):
        noisy = np.rint(depth_mm + rng.normal(0.0, 1.0, depth_mm.shape)).astype(np.uint16)
        checked.add(
            RgbdFrame(
                index=i,
                device_index=i,
                timestamp_us=33_333 * i,
                color_timestamp_us=33_333 * i,
                received_ns=33_333_000 * i,
                depth_mm=noisy,
                color=np.zeros((*depth_mm.shape, 3), np.uint8),
            )
        )
    return {one.code: one for one in checked.findings()}


def test_the_warm_up_is_a_curve_of_depth_and_temperature():
    found = findings(drift_mm=3.0, warms_c=6.0)
    assert found["warmed"].value == pytest.approx(6.0, abs=0.1)
    assert found["temperature"].value == pytest.approx(46.0, abs=0.1)
    assert "temperature" not in findings()
    curve = found["curve"]
    assert 10 <= len(curve) <= 120
    assert curve[0]["s"] < 5.0 < curve[-1]["s"] < FRAMES / 30.0
    assert curve[-1]["depth_mm"] - curve[0]["depth_mm"] == pytest.approx(3.0, abs=0.5)
    assert curve[-1]["temperature_c"] - curve[0]["temperature_c"] == pytest.approx(6.0, abs=1.0)
    assert findings()["curve"][0]["temperature_c"] is None


def test_too_few_frames_have_no_figures():
    checked = DeviceCheck(described=DESCRIBED)
    assert checked.findings() == []
