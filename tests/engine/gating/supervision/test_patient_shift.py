"""A patient who moves on the couch holds; one who breathes, however deeply, does not: on the virtual volunteers."""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from engine.core.frames import NODE_COLUMNS, NODE_ROWS, BodyPosition
from engine.core.gate_state import HoldReason
from engine.gating.limits import GateLimits
from engine.gating.supervision.patient_shift import CORNERS, NODES, MarkersAtReference, PatientShift
from engine.motion.stages.roi import roi_nodes
from engine.motion.stages.surface import end_at_markers, vertices_mm
from lab.phantom.rig import chain, couch_from_body
from lab.phantom.scenarios import Pose
from lab.phantom.scene import Scene, Script
from tests.support.gating.streams import LIMITS, motion_of
from tests.support.motion.small_scene import CAMERA, CORNERS_PX

pytestmark = pytest.mark.slow

DEEPEST_MM = 40.0
LATERAL_MM = 3.0
VOLUNTEERS = range(1, 11)


@lru_cache(maxsize=32)
def scene_of(scenario, volunteer):
    return Scene(Script(scenario=scenario, volunteer=volunteer, seconds=60.0, fps=30.0, seed=1))


def markers_mm(scene, time_s, *, gain=1.0, pose=None):
    """The true stickers in the depth camera's frame, breathing ``gain`` times as deeply, as they lie at that time."""
    camera_from_body = chain(scene.rig.depth_from_couch, couch_from_body(pose or scene.timeline.pose(time_s)))
    return camera_from_body.apply(scene.skin.anchors(gain * scene.breathing.weights(time_s)))


def seen(corners_mm):
    """A motion whose surface has its corners there."""
    surface_mm = np.full((NODES, 3), np.nan)
    surface_mm[list(CORNERS)] = corners_mm
    return replace(motion_of(), surface_mm=surface_mm)


def shift_from(zero_mm, limits: GateLimits = LIMITS):
    watched = PatientShift(limits)
    assert watched.check(seen(zero_mm), has_reference=True) is None
    return watched


@pytest.mark.parametrize("volunteer", VOLUNTEERS)
def test_the_shift_scenario_s_patient_is_found_where_the_scenario_laid_him_and_holds(volunteer):
    scene = scene_of("shift", volunteer)
    pose = scene.timeline.pose(59.0)
    zero_mm = markers_mm(scene, 0.0)
    moved = MarkersAtReference(zero_mm).movement(markers_mm(scene, 59.0))
    # The body turns about its own middle, which the markers lie around.
    assert moved.shift_mm == pytest.approx(math.hypot(pose.x_mm, pose.y_mm), abs=0.6)
    assert moved.turn_deg == pytest.approx(abs(math.degrees(pose.turn_rad)), abs=0.3)
    held = shift_from(zero_mm).check(seen(markers_mm(scene, 59.0)), has_reference=True)
    assert held.reason is HoldReason.PATIENT_SHIFTED
    assert "along the couch" in held.detail


@pytest.mark.parametrize("volunteer", VOLUNTEERS)
@pytest.mark.parametrize("scenario", ["regular", "dibh"])
def test_breathing_up_to_40_mm_with_3_mm_to_the_side_never_trips_it(scenario, volunteer):
    scene = scene_of(scenario, volunteer)
    times_s = np.linspace(0.0, 60.0, 120)
    zero_mm = markers_mm(scene, 0.0)
    lift_mm = max(abs(markers_mm(scene, time_s) - zero_mm)[:, 2].max() for time_s in times_s)
    gain = DEEPEST_MM / lift_mm
    watched = shift_from(markers_mm(scene, 0.0, gain=gain))
    for time_s in times_s:
        breath_mm = markers_mm(scene, time_s, gain=gain)
        share = abs(breath_mm - markers_mm(scene, 0.0, gain=gain))[:, 2].max() / DEEPEST_MM
        aside_mm = np.array([0.0, LATERAL_MM * share, 0.0])
        assert watched.check(seen(breath_mm + aside_mm), has_reference=True) is None


@pytest.mark.parametrize(
    ("pose", "is_held"),
    [
        (Pose(x_mm=5.5), False),
        (Pose(x_mm=6.5), True),
        (Pose(x_mm=-6.5), True),
        (Pose(y_mm=6.5), True),
        (Pose(y_mm=-6.5), True),
        (Pose(turn_rad=math.radians(2.6)), False),
        (Pose(turn_rad=math.radians(3.4)), True),
        (Pose(turn_rad=math.radians(-3.4)), True),
    ],
    ids=str,
)
def test_either_way_along_the_couch_and_either_turn_on_it_is_held_beyond_its_limit(pose, is_held):
    scene = scene_of("regular", 3)
    held = shift_from(markers_mm(scene, 0.0)).check(seen(markers_mm(scene, 0.0, pose=pose)), has_reference=True)
    assert (held is not None) is is_held


@pytest.mark.parametrize("roll_deg", [-3.2, -2.8, 2.8, 3.2])
def test_a_patient_who_rolls_to_the_side_is_held(roll_deg):
    zero_mm = np.array([[-100.0, -150.0, 800.0], [100.0, -150.0, 800.0], [100.0, 150.0, 800.0], [-100.0, 150.0, 800.0]])
    rolled_mm = zero_mm + zero_mm[:, :1] * np.array([0.0, 0.0, math.tan(math.radians(roll_deg))])
    assert MarkersAtReference(zero_mm).movement(rolled_mm).turn_deg == pytest.approx(abs(roll_deg), abs=0.01)
    held = shift_from(zero_mm).check(seen(rolled_mm), has_reference=True)
    assert (held is not None) is (abs(roll_deg) > 3.0)


def test_an_abdomen_that_rises_alone_is_no_turn():
    zero_mm = np.array([[-100.0, -150.0, 800.0], [100.0, -150.0, 800.0], [100.0, 150.0, 800.0], [-100.0, 150.0, 800.0]])
    risen_mm = zero_mm - np.array([[0.0, 0.0, 0.0]] * 2 + [[0.0, 0.0, DEEPEST_MM]] * 2)
    moved = MarkersAtReference(zero_mm).movement(risen_mm)
    assert (moved.shift_mm, moved.turn_deg) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_markers_that_lie_in_no_plane_turn_only_when_they_turn():
    zero_mm = np.array([[-100.0, -150.0, 780.0], [100.0, -150.0, 840.0], [100.0, 150.0, 790.0], [-100.0, 150.0, 860.0]])
    assert MarkersAtReference(zero_mm).movement(zero_mm) == pytest.approx((0.0,) * 5, abs=1e-9)
    breath_mm = zero_mm - np.array([0.0, 0.0, 15.0])
    assert MarkersAtReference(zero_mm).movement(breath_mm).turn_deg == pytest.approx(0.0, abs=1e-9)


def test_a_camera_that_hangs_at_an_angle_sees_the_same_shift():
    zero_mm = np.array([[-100.0, -150.0, 0.0], [100.0, -150.0, 0.0], [100.0, 150.0, 0.0], [-100.0, 150.0, 0.0]])
    tilt = math.radians(35.0)
    rotation = np.array(
        [[1.0, 0.0, 0.0], [0.0, math.cos(tilt), -math.sin(tilt)], [0.0, math.sin(tilt), math.cos(tilt)]]
    )
    camera = np.array([0.0, 0.0, 900.0])
    moved = MarkersAtReference(zero_mm @ rotation.T + camera).movement(
        (zero_mm + np.array([3.0, 4.0, -40.0])) @ rotation.T + camera
    )
    assert moved[:1] + moved[2:] == pytest.approx((5.0, 3.0, 4.0, 0.0), abs=1e-6)
    assert moved.turn_deg == pytest.approx(0.0, abs=1e-6)


def test_the_position_is_taken_anew_when_the_reference_is_and_not_before():
    scene = scene_of("shift", 2)
    before, after = seen(markers_mm(scene, 0.0)), seen(markers_mm(scene, 59.0))
    watched = shift_from(markers_mm(scene, 0.0))
    assert watched.check(after, has_reference=True) is not None
    assert watched.check(None, has_reference=True) is None  # lost for a frame: nothing is forgotten
    assert watched.check(after, has_reference=True) is not None
    watched.reset()
    assert watched.check(after, has_reference=True) is None
    assert watched.check(before, has_reference=True) is not None
    assert watched.check(None, has_reference=False) is None  # a zero that is wanted, and not there yet
    assert watched.check(before, has_reference=True) is None


def test_a_marker_that_is_no_number_is_not_taken_for_one_that_has_not_moved():
    scene = scene_of("regular", 1)
    corners_mm = markers_mm(scene, 0.0)
    bad_mm = corners_mm.copy()
    bad_mm[2, 0] = np.nan
    assert shift_from(corners_mm).check(seen(bad_mm), has_reference=True) is not None


def test_the_corners_of_the_surface_are_the_markers():
    """By the stages' own way: nodes between four markers, pushed out along their rays to a plane 900 mm away."""
    rays = CAMERA.rays(roi_nodes(CORNERS_PX))[:, :2]
    between = end_at_markers(rays, NODE_ROWS, NODE_COLUMNS, 1.0 - 1.0 / 25.0)
    surface_mm = vertices_mm(between, np.full(len(rays), 900.0))
    assert surface_mm.shape == (NODES, 3)
    assert surface_mm[list(CORNERS)] == pytest.approx(
        np.column_stack([CAMERA.rays(CORNERS_PX)[:, :2] * 900.0, np.full(4, 900.0)]), abs=0.2
    )


@pytest.mark.parametrize(
    ("position", "detail"),
    [
        (BodyPosition(measured_us=0, height_mm=3.1, tilt_deg=0.0, roll_deg=0.0), "raised by 3.1 mm, 3 allowed"),
        (BodyPosition(measured_us=0, height_mm=-4.0, tilt_deg=0.0, roll_deg=0.0), "lowered by 4.0 mm, 3 allowed"),
        (BodyPosition(measured_us=0, height_mm=0.0, tilt_deg=-3.2, roll_deg=0.0), "tilted by 3.2 degrees, 3 allowed"),
        (BodyPosition(measured_us=0, height_mm=0.0, tilt_deg=0.0, roll_deg=5.0), "tilted by 5.0 degrees, 3 allowed"),
        (BodyPosition(measured_us=0, height_mm=math.nan, tilt_deg=0.0, roll_deg=0.0), "raised by nan mm, 3 allowed"),
    ],
)
def test_a_surface_that_moved_as_a_whole_holds_and_is_named(position, detail):
    zero_mm = markers_mm(scene_of("regular", 1), 0.0)
    held = shift_from(zero_mm).check(seen(zero_mm), has_reference=True, position=position)
    assert (held.reason, held.detail) == (HoldReason.PATIENT_SHIFTED, detail)


@pytest.mark.parametrize("position", [None, BodyPosition(measured_us=0, height_mm=-2.9, tilt_deg=2.9, roll_deg=-2.9)])
def test_a_position_within_the_limits_holds_nothing(position):
    zero_mm = markers_mm(scene_of("regular", 1), 0.0)
    assert shift_from(zero_mm).check(seen(zero_mm), has_reference=True, position=position) is None


FLAT_MM = np.array([[-100.0, -150.0, 800.0], [100.0, -150.0, 800.0], [100.0, 150.0, 800.0], [-100.0, 150.0, 800.0]])
SHIFTED_MM = FLAT_MM + np.array([3.0, 4.0, 0.0])
TURNED_MM = FLAT_MM @ np.array([[0.998, 0.063, 0.0], [-0.063, 0.998, 0.0], [0.0, 0.0, 1.0]])


def test_a_movement_that_equals_its_limit_holds_nothing_and_beyond_it_is_named():
    moved, turned = (MarkersAtReference(FLAT_MM).movement(now_mm) for now_mm in (SHIFTED_MM, TURNED_MM))
    for now_mm, name, limit, detail in (
        (SHIFTED_MM, "max_shift_mm", moved.shift_mm, "moved 5.0 mm along the couch, 5 allowed"),
        (TURNED_MM, "max_turn_deg", turned.turn_deg, "rotated by 3.6 degrees, 3.61207 allowed"),
    ):
        equal = replace(LIMITS, **{name: limit})
        assert shift_from(FLAT_MM, equal).check(seen(now_mm), has_reference=True) is None
        less = replace(LIMITS, **{name: math.nextafter(limit, 0.0)})
        held = shift_from(FLAT_MM, less).check(seen(now_mm), has_reference=True)
        assert (held.reason, held.detail) == (HoldReason.PATIENT_SHIFTED, detail)


def test_a_turn_about_a_middle_that_has_shifted_too_is_the_same_turn():
    turned = MarkersAtReference(FLAT_MM).movement(TURNED_MM)
    both = MarkersAtReference(FLAT_MM).movement(TURNED_MM + np.array([30.0, -40.0, 0.0]))
    assert both.turn_deg == pytest.approx(turned.turn_deg, abs=1e-9)
    assert both.shift_mm == pytest.approx(50.0, abs=1e-9)


@pytest.mark.parametrize(
    "position",
    [
        BodyPosition(measured_us=0, height_mm=LIMITS.max_height_mm, tilt_deg=0.0, roll_deg=0.0),
        BodyPosition(measured_us=0, height_mm=-LIMITS.max_height_mm, tilt_deg=0.0, roll_deg=0.0),
        BodyPosition(measured_us=0, height_mm=0.0, tilt_deg=LIMITS.max_turn_deg, roll_deg=0.0),
        BodyPosition(measured_us=0, height_mm=0.0, tilt_deg=0.0, roll_deg=-LIMITS.max_turn_deg),
    ],
)
def test_a_position_that_equals_its_limit_holds_nothing(position):
    assert shift_from(FLAT_MM).check(seen(FLAT_MM), has_reference=True, position=position) is None


def test_a_small_rise_beyond_a_narrow_limit_is_a_rise():
    narrow = replace(LIMITS, max_height_mm=0.5)
    position = BodyPosition(measured_us=0, height_mm=0.6, tilt_deg=0.0, roll_deg=0.0)
    held = shift_from(FLAT_MM, narrow).check(seen(FLAT_MM), has_reference=True, position=position)
    assert held.detail == "raised by 0.6 mm, 0.5 allowed"


def test_markers_of_single_precision_are_compared_in_double():
    uneven_mm = np.random.default_rng(5).normal(0.0, 4.0, (2, 4, 3))
    zero_mm, now_mm = ((FLAT_MM + one).astype(np.float32) for one in uneven_mm)

    def single(corners_mm):
        surface_mm = np.zeros((NODES, 3), dtype=np.float32)
        surface_mm[list(CORNERS)] = corners_mm
        return replace(motion_of(), surface_mm=surface_mm)

    watched = PatientShift(LIMITS)
    watched.check(single(zero_mm), has_reference=True)
    watched.check(single(now_mm), has_reference=True)
    assert watched.movement == MarkersAtReference(zero_mm.astype(np.float64)).movement(now_mm.astype(np.float64))


def sliding(slide_mm, *, is_on_part=True, seconds=12.0, **limits):
    """Markers that slide along the body with each breath; return what watched them, and its last hold."""
    limits = {"max_marker_travel_mm": 3.0} | limits
    watched, found = shift_from(FLAT_MM, replace(LIMITS, **limits)), None
    for index in range(round(30.0 * seconds)):
        along_mm = 0.5 * slide_mm * (1.0 - math.cos(1.5 * index / 30.0))
        motion = seen(FLAT_MM + np.array([0.0, along_mm, 0.0]))
        found = watched.check(motion, has_reference=True, timestamp_us=round(index * 1e6 / 30.0), is_on_part=is_on_part)
    return watched, found


@pytest.mark.parametrize(("slide_mm", "is_held"), [(2.9, False), (3.1, True)])
def test_markers_that_slide_with_the_breath_hold_a_window_on_a_part(slide_mm, is_held):
    watched, found = sliding(slide_mm)
    assert watched.travel_mm == pytest.approx(slide_mm, abs=0.05)
    assert (found is not None) is is_held
    if is_held:
        assert found.reason is HoldReason.PATIENT_SHIFTED
        assert "slide by 3.1 mm with the breath, 3 allowed for a window on a part" in found.detail
    assert sliding(slide_mm, is_on_part=False)[1] is None
    assert sliding(slide_mm, max_marker_travel_mm=2.0)[1] is not None


def test_a_travel_ends_ten_seconds_later_and_with_a_new_reference():
    watched, _ = sliding(5.0)
    for index in range(2 * 300 + 60):
        found = watched.check(
            seen(FLAT_MM), has_reference=True, timestamp_us=round(12e6 + index * 1e6 / 60.0), is_on_part=True
        )
    assert found is None
    assert watched.travel_mm == pytest.approx(0.0, abs=1e-6)
    watched, found = sliding(5.0)
    assert found is not None
    watched.reset()
    assert watched.check(seen(FLAT_MM), has_reference=True, timestamp_us=0, is_on_part=True) is None
    assert watched.travel_mm is None or watched.travel_mm == 0.0


def test_no_movement_is_known_between_a_new_reference_and_its_first_frame():
    watched, _ = sliding(5.0)
    watched.reset()
    assert watched.movement is None
    assert watched.travel_mm is None
