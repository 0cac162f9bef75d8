"""The movement of the camera is measured on couch and floor, not on the patient."""

import numpy as np
import pytest

from engine.motion.cross_check.static_scene import StaticScene
from tests.support.motion.static_room import CAMERA, FRAMES, MARKERS_MM, RAYS_X, STEP_US, scene_mm


def learned(**scene):
    found = StaticScene(CAMERA)
    for number in range(FRAMES):
        assert found.follow(scene_mm(seed=number, **scene)[::4, ::4], MARKERS_MM, number * STEP_US) is None
    return found


@pytest.fixture(scope="module")
def scene():
    return learned()


def moved_mm(scene, depth_mm):
    return scene.follow(depth_mm[::4, ::4], MARKERS_MM, FRAMES * STEP_US)


def test_a_camera_that_stands_still_has_not_moved(scene):
    assert np.abs(moved_mm(scene, scene_mm(seed=90))).max() < 0.4


@pytest.mark.parametrize("lowered_mm", [2.0, -4.0, 10.0])
def test_a_camera_lowered_is_measured(scene, lowered_mm):
    assert moved_mm(scene, scene_mm(lowered_mm=lowered_mm, seed=91)) == pytest.approx([-lowered_mm] * 4, abs=0.5)


def test_a_camera_tilted_is_measured_at_each_marker(scene):
    tilt_rad = np.deg2rad(0.5)
    assert moved_mm(scene, scene_mm(tilt_rad=tilt_rad, seed=92)) == pytest.approx(tilt_rad * MARKERS_MM[:, 1], abs=0.5)


WIDE = {"couch_half_mm": 420.0}


@pytest.fixture(scope="module")
def wide():
    """A scene whose couch and floor are both seen."""
    return learned(**WIDE)


@pytest.mark.parametrize("couch_mm", [2.0, -1.7, 8.0])
def test_a_couch_that_moves_over_a_floor_that_stays_is_measured_and_named(wide, couch_mm):
    found = moved_mm(wide, scene_mm(couch_mm=couch_mm, seed=91, **WIDE))
    assert found == pytest.approx([couch_mm] * 4, abs=0.3)
    assert wide.has_floor_moved is False


@pytest.mark.parametrize("lowered_mm", [2.0, -4.0, 10.0])
def test_a_camera_that_moves_takes_the_floor_along(wide, lowered_mm):
    found = moved_mm(wide, scene_mm(lowered_mm=lowered_mm, seed=91, **WIDE))
    assert found == pytest.approx([-lowered_mm] * 4, abs=0.5)
    assert wide.has_floor_moved is True


def test_a_camera_that_tilts_takes_the_floor_along(wide):
    moved_mm(wide, scene_mm(tilt_rad=np.deg2rad(0.6), seed=92, **WIDE))
    assert wide.has_floor_moved is True


def test_what_has_moved_is_not_known_where_nothing_or_one_of_both_is_seen(wide, scene):
    assert np.abs(moved_mm(wide, scene_mm(seed=92, **WIDE))).max() < 0.4
    assert wide.has_floor_moved is None
    moved_mm(scene, scene_mm(lowered_mm=3.0, seed=93))
    assert scene.has_floor_moved is None, "too little of the couch is seen there"
    covered = scene_mm(couch_mm=5.0, seed=94, **WIDE)
    covered[np.abs(RAYS_X * 1020.0) > WIDE["couch_half_mm"]] = 700
    moved_mm(wide, covered)
    assert wide.has_floor_moved is None


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


def test_a_scene_that_was_hidden_at_the_reference_is_learned_when_it_is_seen():
    found = learned(has_room=False)
    known = [
        found.follow(scene_mm(seed=number)[::4, ::4], MARKERS_MM, (FRAMES + number) * STEP_US) is not None
        for number in range(2 * FRAMES)
    ]
    assert known.index(True) >= FRAMES - 1, "a whole second teaches it, as at first"
    later_us = 3 * FRAMES * STEP_US
    assert np.abs(found.follow(scene_mm(seed=98)[::4, ::4], MARKERS_MM, later_us)).max() < 0.4
    lowered = found.follow(scene_mm(lowered_mm=3.0, seed=99)[::4, ::4], MARKERS_MM, later_us + STEP_US)
    assert lowered == pytest.approx([-3.0] * 4, abs=0.5)


def test_a_restart_learns_the_scene_again():
    found = learned()
    found.restart()
    lowered = scene_mm(lowered_mm=5.0, seed=97)
    for number in range(FRAMES):
        assert found.follow(lowered[::4, ::4], MARKERS_MM, number * STEP_US) is None
    assert np.abs(moved_mm(found, scene_mm(lowered_mm=5.0, seed=98))).max() < 0.4


def test_pictures_of_another_size_are_not_measured(scene):
    assert moved_mm(scene, np.full((240, 320), 1000, dtype=np.uint16)) is None
