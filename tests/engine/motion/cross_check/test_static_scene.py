"""The movement of the camera is measured on couch and floor, not on the patient."""

import numpy as np
import pytest

from engine.core.geometry import Intrinsics
from engine.motion.cross_check.static_scene import LEARNING_US, StaticScene

CAMERA = Intrinsics(width=640, height=480, fx=575.0, fy=575.0, cx=319.5, cy=239.5)
Y, X = np.mgrid[0:480, 0:640].astype(np.float64)
RAYS_X, RAYS_Y = (X - CAMERA.cx) / CAMERA.fx, (Y - CAMERA.cy) / CAMERA.fy
MARKERS_MM = np.array([[-120.0, -150.0, 850.0], [120.0, -150.0, 850.0], [120.0, 150.0, 850.0], [-120.0, 150.0, 850.0]])
STEP_US = 33_333
FRAMES = LEARNING_US // STEP_US + 2


def scene_mm(*, lowered_mm=0.0, tilt_rad=0.0, chest_mm=0.0, person=False, has_room=True, seed=1):
    """A round body on a couch at 1.02 m over a floor at 1.7 m; the camera is lowered, or tilted about x."""
    room = np.where(np.abs(RAYS_X * 1020.0) < 300.0, 1020.0, 1700.0)
    moved = room - lowered_mm + tilt_rad * RAYS_Y * room
    body = 850.0 + 0.002 * (X - 320.0) ** 2 - chest_mm - lowered_mm + tilt_rad * RAYS_Y * 850.0
    is_body = (np.abs(X - 320.0) < 130.0) & (np.abs(Y - 240.0) < 210.0)
    depth = np.where(is_body, body, moved)
    if person:
        depth[:, :160] = 700.0
    if not has_room:
        depth[~is_body] = 0.0
    noise = np.random.default_rng(seed).normal(0.0, 1.5, depth.shape) * (depth / 1000.0) ** 2
    return np.clip(np.rint(depth + noise), 0, 9000).astype(np.uint16)


def learned(**scene):
    found = StaticScene(CAMERA)
    for number in range(FRAMES):
        assert found.follow(scene_mm(seed=number, **scene), MARKERS_MM, number * STEP_US) is None
    return found


@pytest.fixture(scope="module")
def scene():
    return learned()


def moved_mm(scene, depth_mm):
    return scene.follow(depth_mm, MARKERS_MM, FRAMES * STEP_US)


def test_a_camera_that_stands_still_has_not_moved(scene):
    assert np.abs(moved_mm(scene, scene_mm(seed=90))).max() < 0.4


@pytest.mark.parametrize("lowered_mm", [2.0, -4.0, 10.0])
def test_a_camera_lowered_is_measured(scene, lowered_mm):
    assert moved_mm(scene, scene_mm(lowered_mm=lowered_mm, seed=91)) == pytest.approx([-lowered_mm] * 4, abs=0.5)


def test_a_camera_tilted_is_measured_at_each_marker(scene):
    tilt_rad = np.deg2rad(0.5)
    assert moved_mm(scene, scene_mm(tilt_rad=tilt_rad, seed=92)) == pytest.approx(tilt_rad * MARKERS_MM[:, 1], abs=0.5)


def test_a_patient_who_moves_or_breathes_is_not_the_camera(scene):
    assert np.abs(moved_mm(scene, scene_mm(chest_mm=10.0, seed=93))).max() < 0.4


def test_a_person_beside_the_couch_is_left_out(scene):
    assert moved_mm(scene, scene_mm(person=True, lowered_mm=3.0, seed=94)) == pytest.approx([-3.0] * 4, abs=0.6)


def test_nothing_is_measured_where_the_scene_is_covered_or_was_never_seen(scene):
    covered = scene_mm(seed=95)
    covered[:, 120:520] = 700
    covered[:200] = 700
    assert moved_mm(scene, covered) is None
    assert moved_mm(learned(has_room=False), scene_mm(has_room=False, seed=96)) is None


def test_a_restart_learns_the_scene_anew():
    found = learned()
    found.restart()
    lowered = scene_mm(lowered_mm=5.0, seed=97)
    for number in range(FRAMES):
        assert found.follow(lowered, MARKERS_MM, number * STEP_US) is None
    assert np.abs(moved_mm(found, scene_mm(lowered_mm=5.0, seed=98))).max() < 0.4


def test_pictures_of_another_size_are_not_measured(scene):
    assert moved_mm(scene, np.full((240, 320), 1000, dtype=np.uint16)) is None
