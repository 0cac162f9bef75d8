"""How the camera looks: known planes, gaps and light are found; arbitrary pictures never fail."""

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from engine.calibration.camera_view import PERIOD_NS, CameraViewMeter, camera_view
from engine.core.frames import RgbdFrame
from engine.core.geometry import Intrinsics
from engine.core.position_check import CameraAdvice
from engine.core.warmth import Warmth

DEPTH = Intrinsics(width=640, height=480, fx=570.0, fy=570.0, cx=319.5, cy=239.5)
GREY = np.full((480, 640, 3), 120, np.uint8)


def plane_mm(distance_mm=850.0, tilt_deg=0.0, towards_deg=0.0):
    """Depth of a plane through the optical axis at this distance, tilted towards a direction of the picture."""
    row, column = np.mgrid[:480, :640]
    x, y = (column - DEPTH.cx) / DEPTH.fx, (row - DEPTH.cy) / DEPTH.fy
    along = x * math.cos(math.radians(towards_deg)) + y * math.sin(math.radians(towards_deg))
    return np.round(distance_mm / (1.0 - along * math.tan(math.radians(tilt_deg)))).astype(np.uint16)


def frame(depth_mm=None, color=GREY, at_s=0.0):
    depth_mm = plane_mm() if depth_mm is None else depth_mm
    stamps = {"timestamp_us": 0, "color_timestamp_us": 0, "received_ns": 10**9 + round(at_s * 1e9)}
    return RgbdFrame(index=0, device_index=0, depth_mm=depth_mm, color=color, **stamps)


def seen(depth_mm=None, color=GREY, *, warm_in_s=0.0):
    return camera_view(frame(depth_mm, color), DEPTH, running_s=0.0, warm_in_s=warm_in_s)


@pytest.mark.parametrize("distance_mm", [700.0, 1100.0])
@pytest.mark.parametrize("towards_deg", [0.0, 60.0, 90.0, 200.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 5.0, 14.0, 20.0])
def test_a_plane_s_distance_and_tilt_are_found(tilt_deg, towards_deg, distance_mm):
    found = seen(plane_mm(distance_mm, tilt_deg, towards_deg))
    assert found.tilt_deg == pytest.approx(tilt_deg, abs=0.3)
    assert found.distance_mm == pytest.approx(distance_mm, rel=0.015)
    assert (CameraAdvice.TILTED in found.advice) is (tilt_deg > 15.0)


def test_a_belly_on_the_plane_changes_its_tilt_little():
    depth_mm = plane_mm(850.0, 5.0)
    depth_mm[160:320, 160:240] -= 60
    assert seen(depth_mm).tilt_deg == pytest.approx(5.0, abs=1.0)


@pytest.mark.parametrize(
    ("distance_mm", "advice"), [(550, CameraAdvice.TOO_NEAR), (850, None), (1150, None), (1300, CameraAdvice.TOO_FAR)]
)
def test_a_distance_out_of_range_is_advised_against(distance_mm, advice):
    assert seen(plane_mm(distance_mm)).advice == (() if advice is None else (advice,))


def test_gaps_are_counted_in_the_middle_only():
    beside, within = plane_mm(), plane_mm()
    beside[:, :150] = within[:, 300:] = 0
    assert seen(beside).coverage == 1.0
    found = seen(within)
    assert found.coverage == pytest.approx(140 / 320, abs=0.02)
    assert found.advice == (CameraAdvice.GAPS,)


def test_without_a_reading_distance_and_tilt_are_unknown():
    found = seen(np.zeros((480, 640), np.uint16))
    assert math.isnan(found.distance_mm)
    assert math.isnan(found.tilt_deg)
    assert found.advice == (CameraAdvice.GAPS,)


def test_light_is_judged():
    lamp = GREY.copy()
    lamp[200:280, 280:360] = 255
    assert seen(color=GREY // 12).advice == (CameraAdvice.TOO_DARK,)
    assert seen(color=lamp).advice == (CameraAdvice.TOO_BRIGHT,)
    assert seen(color=np.full_like(GREY, 230)).advice == (CameraAdvice.TOO_BRIGHT,)
    assert seen().brightness == pytest.approx(120 / 255)


def test_a_camera_that_is_not_warm_yet_says_for_how_long():
    found = seen(warm_in_s=0.5)
    assert (found.advice, found.warm_in_s) == ((CameraAdvice.WARMING_UP,), 0.5)
    assert seen().advice == ()


def test_a_frame_is_looked_at_once_a_second():
    warmth = Warmth(900.0)
    meter = CameraViewMeter(DEPTH, warmth)
    first = meter.look(frame(at_s=0.0))
    assert meter.look(frame(plane_mm(1300), at_s=0.99)) is first
    later = meter.look(frame(plane_mm(1300), at_s=PERIOD_NS / 1e9))
    assert (later.distance_mm, later.running_s) == (1300.0, 1.0)
    assert (later.warm_in_s, later.advice[-1]) == (pytest.approx(900.0), CameraAdvice.WARMING_UP)
    warmth.run(901.0)
    assert CameraAdvice.WARMING_UP not in meter.look(frame(at_s=2.0)).advice


@given(st.integers(0, 2**32 - 1), st.sampled_from([(48, 64), (240, 320), (480, 640), (7, 9), (1, 1)]), st.floats(0, 1))
def test_arbitrary_pictures_never_fail(seed, shape, share):
    rng = np.random.default_rng(seed)
    depth_mm = np.where(rng.random(shape) < share, rng.integers(0, 65536, shape), 0).astype(np.uint16)
    color = rng.integers(0, 256, (*shape, 3)).astype(np.uint8)
    found = camera_view(frame(depth_mm, color), DEPTH, running_s=0.0, warm_in_s=900.0)
    assert 0.0 <= found.coverage <= 1.0
    assert math.isnan(found.tilt_deg) or 0.0 <= found.tilt_deg <= 90.0
