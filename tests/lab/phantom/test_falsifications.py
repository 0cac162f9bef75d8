"""Falsified scenes: what is added is in the pictures, and the truth stays the patient's."""

from functools import cache

import numpy as np
import pytest

from lab.phantom.falsifications import (
    Blind,
    CameraFault,
    Cover,
    Falsification,
    Limb,
    Move,
    MovedMarker,
    Part,
)
from lab.phantom.scene import Script
from lab.phantom.studio import Studio

pytestmark = pytest.mark.slow

VOLUNTEER, SEED = 3, 5
START_S, AT_S = 20.0, 21.0
FRAME = 630


@cache
def studio(falsification: Falsification | None = None) -> Studio:
    script = Script(
        scenario="regular", volunteer=VOLUNTEER, seconds=40.0, fps=30.0, seed=SEED, falsification=falsification
    )
    return Studio(script)


def false(**parts: object) -> Studio:
    return studio(Falsification(start_s=START_S, **parts))


def raised_mm(changed: Studio, time_s: float = AT_S) -> np.ndarray:
    """How much nearer to the camera the scene is than the honest one [mm]."""
    return studio().true_depth(time_s) - changed.true_depth(time_s)


def cells_mm(changed: Studio, time_s: float = AT_S) -> np.ndarray:
    """True depth of the cells [mm], shape (35, 20)."""
    scene = changed.scene
    return scene.roi_truth(time_s).cells(scene.breathing.weights(time_s), scene.raised_share(time_s))[0]


def at_grid(changed: Studio, picture: np.ndarray, row: float, column: float) -> float:
    """Value of a depth picture near a point of the region, from 0 to 1 along and across it."""
    corners = changed.scene.markers_px(AT_S)
    top, bottom = corners[0] + column * (corners[1] - corners[0]), corners[3] + column * (corners[2] - corners[3])
    x, y = np.rint(top + row * (bottom - top)).astype(int)
    return float(np.median(picture[y - 3 : y + 4, x - 3 : x + 4]))


def test_nothing_is_false_before_its_time_and_in_an_empty_falsification():
    sheet = false(cover=Cover(height_mm=8.0))
    assert np.array_equal(studio().depth_frame(FRAME, START_S - 0.1), sheet.depth_frame(FRAME, START_S - 0.1))
    assert np.array_equal(studio().color_frame(FRAME, AT_S), false().color_frame(FRAME, AT_S))
    assert np.array_equal(studio().depth_frame(FRAME, AT_S), false().depth_frame(FRAME, AT_S))


def test_a_sheet_over_half_is_over_the_inferior_half_and_the_truth_is_the_skin_below():
    sheet = false(cover=Cover(height_mm=8.0))
    rise = raised_mm(sheet)
    assert at_grid(sheet, rise, 0.75, 0.5) == pytest.approx(8.0, abs=0.7)
    assert at_grid(sheet, rise, 0.25, 0.5) == 0.0
    assert np.array_equal(cells_mm(sheet), cells_mm(studio()))


@pytest.mark.parametrize(("part", "superior_right", "inferior_left"), [(Part.SIDE, 0.0, 5.0), (Part.WHOLE, 5.0, 5.0)])
def test_a_sheet_covers_its_part(part, superior_right, inferior_left):
    sheet = false(cover=Cover(height_mm=5.0, part=part))
    rise = raised_mm(sheet)
    assert at_grid(sheet, rise, 0.25, 0.2) == pytest.approx(superior_right, abs=0.7)
    assert at_grid(sheet, rise, 0.75, 0.8) == pytest.approx(inferior_left, abs=0.7)


def test_a_sheet_has_its_colour_and_leaves_the_stickers_free():
    sheet = false(cover=Cover(height_mm=8.0))
    before, after = (one.color_frame(FRAME, AT_S).astype(int) for one in (studio(), sheet))
    change = np.abs(after - before).max(axis=2)
    assert at_grid(sheet, change, 0.75, 0.5) > 15
    for x, y in np.rint(sheet.scene.markers_px(AT_S)).astype(int):
        assert change[y - 2 : y + 3, x - 2 : x + 3].max() < 15


def test_a_drawn_drape_comes_from_the_inferior_end_with_its_speed_and_its_soft_edge():
    drape = false(cover=Cover(height_mm=8.0, speed_mm_s=100.0, edge_mm=60.0))
    early, late = (raised_mm(drape, START_S + elapsed_s) for elapsed_s in (1.5, 3.5))
    assert at_grid(drape, early, 0.6, 0.5) == 0.0
    assert at_grid(drape, early, 0.95, 0.5) > 0.5
    assert at_grid(drape, late, 0.8, 0.5) == pytest.approx(8.0, abs=0.7)
    assert 0.2 < at_grid(drape, late, 0.55, 0.5) < 7.0


def test_a_marker_is_hidden_and_then_back_elsewhere_while_the_skin_stays():
    moved = false(marker=MovedMarker(marker=2, outward_mm=20.0, away_s=0.5))
    assert np.array_equal(studio().true_depth(AT_S), moved.true_depth(AT_S))
    old, new = (one._anchors(AT_S)[2] for one in (studio(), moved))
    assert np.hypot(*(new - old)[:2]) == pytest.approx(20.0)
    x, y = np.rint(moved.scene.markers_px(AT_S)[2]).astype(int)
    honest, hidden, back = (
        one.color_frame(FRAME, time_s)[y, x].min()
        for one, time_s in ((studio(), AT_S), (moved, START_S + 0.2), (moved, AT_S))
    )
    assert honest > 150
    assert max(hidden, back) < 120


def test_a_blind_area_has_no_reading_and_the_skin_below_it_rises_in_the_truth():
    blind = false(blind=Blind(first=0.8, last=1.05, raised_mm=8.0))
    readings = blind.depth_frame(FRAME, AT_S)
    assert at_grid(blind, readings, 0.93, 0.5) == 0
    assert at_grid(blind, readings, 0.4, 0.5) > 0
    rise = cells_mm(studio()) - cells_mm(blind)
    assert rise[31:].min() == pytest.approx(8.0, abs=0.8)
    assert abs(rise[:24]).max() < 0.05


@pytest.mark.parametrize("is_camera", [False, True])
def test_a_raised_body_is_nearer_with_the_couch_only_where_the_camera_came_down(is_camera):
    move = Move(up_mm=10.0)
    moved = false(camera=move) if is_camera else false(body=move)
    rise = raised_mm(moved)
    assert at_grid(moved, rise, 0.5, 0.5) == pytest.approx(10.0, abs=0.5)
    assert np.median(rise[5:40, 5:40]) == pytest.approx(10.0 if is_camera else 0.0, abs=0.5)
    truth = cells_mm(studio()) - cells_mm(moved)
    assert truth.mean() == pytest.approx(0.0 if is_camera else 10.0, abs=0.1)


def test_a_tilted_body_rises_at_one_end_and_sinks_at_the_other():
    rise = cells_mm(studio()) - cells_mm(false(body=Move(tilt_deg=2.0)))
    assert rise[0].mean() * rise[-1].mean() < 0.0
    assert abs(rise.mean()) < 2.5


def test_a_slow_move_is_made_in_steps():
    move = Move(up_mm=4.0, over_s=60.0, steps=4)
    assert [move.pose(elapsed_s).z_mm for elapsed_s in (0.0, 7.0, 20.0, 30.0, 90.0)] == [0.0, 0.0, -1.0, -2.0, -4.0]


def test_a_blanket_makes_a_share_of_the_motion_below_it_and_the_truth_is_the_skin():
    blanket = false(cover=Cover(height_mm=6.0, part=Part.WHOLE, follows=0.7))
    times_s = np.arange(START_S + 0.5, START_S + 5.0, 0.25)
    seen = np.array([at_grid(blanket, blanket.true_depth(time_s), 0.8, 0.5) for time_s in times_s])
    skin = np.array([at_grid(blanket, studio().true_depth(time_s), 0.8, 0.5) for time_s in times_s])
    assert np.ptp(seen) / np.ptp(skin) == pytest.approx(0.7, abs=0.03)
    assert np.array_equal(cells_mm(blanket), cells_mm(studio()))


def test_soaked_cloth_sinks_and_darkens_with_time():
    soaked = false(cover=Cover(height_mm=-3.0, edge_mm=40.0, has_color=False, laid_s=10.0, darkens=0.5))
    early, late = (at_grid(soaked, raised_mm(soaked, START_S + s), 0.9, 0.5) for s in (5.0, 10.0))
    assert (early, late) == pytest.approx((-1.5, -3.0), abs=0.2)
    before, after = (one.color_frame(FRAME, START_S + 10.0).sum(axis=2) for one in (studio(), soaked))
    assert at_grid(soaked, after, 0.9, 0.5) / at_grid(soaked, before, 0.9, 0.5) == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(("follows", "swing"), [(0.0, 0.0), (1.0, 1.0)])
def test_an_arm_lies_over_the_body_and_moves_with_the_breath_or_not(follows, swing):
    arm = false(limb=Limb(y_mm=70.0, reach_mm=-60.0, follows=follows))
    times_s = np.arange(START_S + 1.0, START_S + 5.0, 0.25)
    seen = np.array([at_grid(arm, arm.true_depth(time_s), 0.72, 0.5) for time_s in times_s])
    middle = np.array([arm._middle_mm(time_s) for time_s in times_s])
    assert (at_grid(arm, raised_mm(arm), 0.72, 0.5), at_grid(arm, raised_mm(arm), 0.1, 0.5)) > (40.0, -0.1)
    assert np.ptp(seen) == pytest.approx(swing * np.ptp(middle), abs=0.3)


def test_a_saturated_camera_delivers_nothing_nearer_than_its_limit():
    build = studio().scene.anatomy.build
    clipped = false(fault=CameraFault(clips_mm=0.0)).depth_frame(FRAME, AT_S)
    honest = studio().depth_frame(FRAME, AT_S)
    assert clipped[clipped > 0].min() == round(build.camera_mm)
    assert np.array_equal(clipped[honest > build.camera_mm], honest[honest > build.camera_mm])
    assert np.array_equal(clipped == 0, honest == 0)
