"""The figures of a camera that looks at a still surface: each fault has its own, and a good camera has none."""

import numpy as np
import pytest

from engine.capture import SourceDescription
from engine.core.frames import RgbdFrame
from engine.qa.device_check import DeviceCheck

SIZE = (128, 128)
DESCRIBED = SourceDescription(
    kind="made up", name="Made up", depth_size=SIZE, color_size=SIZE, fps=30.0, is_live=True, serial="1"
)
FRAMES = 1200


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
        checked.add(frame)
    return {one.code: one for one in checked.findings()}


def test_a_good_camera_passes_and_its_noise_is_the_true_one():
    found = findings()
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


def test_too_few_frames_have_no_figures():
    checked = DeviceCheck(described=DESCRIBED)
    assert checked.findings() == []
