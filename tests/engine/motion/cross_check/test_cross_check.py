"""A moved camera, a cover and a moved patient are distinguished; each ends when it is gone, or with a new reference."""

import math
import sys
from copy import deepcopy
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from engine.core.frames import Evidence, LostReason, Markers, RgbdFrame, RoiDepth, ThinViews
from engine.motion.cross_check import cell_surface
from engine.motion.cross_check.cell_surface import learn_shapes
from engine.motion.cross_check.cross_check import AVERAGED_US, CrossCheck
from tests.support.motion.small_scene import CALIBRATION
from tests.support.motion.static_room import CAMERA, FRAMES, STEP_US, scene_mm

MARKERS = Markers(centers_px=np.array([[240.0, 110.0], [400.0, 110.0], [400.0, 380.0], [240.0, 380.0]]))
MARKER_RAYS = CAMERA.rays(MARKERS.centers_px)
ROWS, COLUMNS = np.mgrid[0:88, 0:50]
CHEST, BELLY = np.exp(-(((ROWS - 20) / 30.0) ** 2)), np.exp(-(((ROWS - 65) / 25.0) ** 2))
REST_MM = 850.0 + 0.01 * (COLUMNS - 25.0) ** 2


def calibration():
    return replace(CALIBRATION, depth=CAMERA, color=CAMERA)


@cache
def room_mm(camera_mm, number):
    """One of four depth pictures of the room."""
    return scene_mm(lowered_mm=camera_mm, seed=number)


@cache
def picture(rgb):
    color = np.full((480, 640, 3), 150, dtype=np.uint8)
    color[100:390, 230:320], color[100:390, 320:410] = (150, 140, 120), rgb
    return color


def stored_model():
    """What is used of a model; without components, so that only the training's frames can teach the shapes."""
    return SimpleNamespace(components=np.zeros((2, 350, 200), dtype=np.float32), noise_mm=3.0, scores_mm=None)


class Session:
    """Frames of a breathing patient, taken one after the other; what is false about them stays so."""

    def __init__(self):
        self.check, self.index = CrossCheck(calibration()), 0
        self.model, self.learned = stored_model(), None
        self.sheet_mm = self.raised_mm = self.camera_mm = 0.0
        self.inferior_mm = self.left_mm = 0.0
        self.depth, self.has_depth, self.has_room = 1.0, True, True
        self.color = (150, 140, 120)
        self.hidden_corner, self.has_shoulders, self.is_lost_otherwise = False, False, False
        self.has_rolling_holes = False
        self.cells_seen = 80

    def observe(self):
        noise = np.random.default_rng(self.index)
        seconds = self.index * STEP_US / 1e6
        breath = 2.0 - 2.0 * np.cos(1.5 * seconds - 0.4), 5.0 - 5.0 * np.cos(1.5 * seconds)
        breath = self.depth * breath[0], self.depth**1.5 * breath[1]
        shoulders_mm = max(breath[1] - 15.0, 0.0) * 0.15 * self.has_shoulders
        depth = REST_MM - shoulders_mm - breath[0] * CHEST - breath[1] * BELLY - self.raised_mm - self.camera_mm
        depth -= self.sheet_mm * (COLUMNS >= 25)
        depth -= self.inferior_mm * (ROWS - 43.5) / 44.0 + self.left_mm * (COLUMNS - 24.5) / 25.0
        valid = np.full(depth.shape, self.has_depth)
        valid[:12, :6] &= not self.hidden_corner
        if self.has_rolling_holes:
            valid &= (ROWS + 8 * self.index) % 48 >= 8
        cell = ROWS // 11 * 10 + COLUMNS // 5
        valid &= cell < self.cells_seen
        roi = RoiDepth(
            depth_mm=(depth + noise.normal(0.0, 0.9, depth.shape)).astype(np.float32),
            valid=valid,
            stride_px=4,
        )
        frame = RgbdFrame(
            index=self.index,
            device_index=self.index,
            timestamp_us=self.index * STEP_US,
            color_timestamp_us=self.index * STEP_US,
            received_ns=self.index * STEP_US * 1000,
            depth_mm=room_mm(self.camera_mm, self.index % 4) * np.uint16(self.has_room),
            color=picture(self.color),
        )
        views = ThinViews(frame.depth_mm[::4, ::4], frame.color[::16, ::16])
        self.check.observe(frame, views, MARKERS, MARKER_RAYS, roi)
        self.index += 1

    def run(self, frames, *, is_reference_due=False):
        """Take frames; return the loss of each, or the doubt in which it is measured."""
        found = []
        for _ in range(frames):
            self.observe()
            lost = self.check.lost(self.model, is_reference_due=is_reference_due, learned=self.learned)
            found.append(lost or self.check.doubt)
            if lost is None and not self.is_lost_otherwise:
                self.check.confirm()
            is_reference_due = False
        return found


@pytest.fixture(scope="module")
def learned():
    """A session whose model was learned, and whose reference was set long enough ago for the scene to be known."""
    found = Session()
    for _ in range(150):
        found.observe()
        found.check.gather()
    assert found.run(FRAMES + 10, is_reference_due=True) == [None] * (FRAMES + 10)
    return found


@pytest.fixture
def session(learned):
    return deepcopy(learned)


SOON = AVERAGED_US // STEP_US + 4


def reasons(losses):
    return [None if one is None else one.reason for one in losses]


def test_breathing_for_minutes_is_never_lost(session):
    assert session.run(300) == [None] * 300
    assert abs(session.check.position.height_mm) < 0.6


def test_breaths_deeper_and_of_another_shape_than_in_the_training_are_not_lost(session):
    session.depth = 2.5
    assert session.run(150) == [None] * 150


def test_a_sheet_of_the_patients_colour_is_lost_until_it_is_gone(session):
    session.sheet_mm = 3.0
    losses = session.run(40)
    assert reasons(losses[SOON:]) == [LostReason.SURFACE_CHANGED] * (40 - SOON)
    assert "mm from breathing" in losses[-1].detail
    session.sheet_mm = 0.0
    assert session.run(40)[SOON:] == [None] * (40 - SOON)


def test_another_colour_is_lost_at_once_however_thin_the_object_is(session):
    session.color = (62, 112, 98)
    assert reasons(session.run(5)) == [LostReason.SURFACE_CHANGED] * 5
    session.color = (150, 140, 120)
    assert session.run(5) == [None] * 5


def test_holes_that_roll_hide_no_sheet(session):
    """One sixth of the region is hidden, another one in each frame: few cells are seen in all of the last frames."""
    session.has_rolling_holes = True
    assert session.run(90) == [None] * 90
    session.sheet_mm = 3.0
    assert reasons(session.run(30)[SOON:]) == [LostReason.SURFACE_CHANGED] * (30 - SOON)
    session.sheet_mm = 0.0
    assert session.run(30)[SOON:] == [None] * (30 - SOON)


@pytest.mark.parametrize(("lowered_mm", "has_moved"), [(1.0, False), (-1.0, False), (2.0, True), (-2.0, True)])
def test_a_camera_that_moved_is_named_from_a_millimetre_and_a_half(session, lowered_mm, has_moved):
    """The pictures have whole millimetres."""
    session.camera_mm = lowered_mm
    assert reasons(session.run(40)[SOON:]) == [LostReason.CAMERA_MOVED if has_moved else None] * (40 - SOON)


@pytest.mark.parametrize(("height_px", "is_lost"), [(40, False), (104, True)])
def test_another_colour_is_an_object_from_six_per_cent_of_the_region(session, monkeypatch, height_px, is_lost):
    """An object over a quarter of the region's width, of 270 px in height: 4 and 10 % of it."""
    color = picture(session.color).copy()
    color[140 : 140 + height_px, 280:320] = (90, 130, 120)
    monkeypatch.setattr(sys.modules[__name__], "picture", lambda _rgb: color)
    assert reasons(session.run(10)) == [LostReason.SURFACE_CHANGED if is_lost else None] * 10


def test_a_camera_that_moved_after_a_reference_without_couch_and_floor_is_named(session):
    session.has_room = False
    session.run(2 * FRAMES, is_reference_due=True)
    session.has_room = True
    assert session.run(2 * FRAMES) == [None] * (2 * FRAMES)
    session.camera_mm = 3.0
    assert reasons(session.run(20)[SOON:]) == [LostReason.CAMERA_MOVED] * (20 - SOON)


@pytest.mark.parametrize("rgb", [(0, 0, 0), (12, 10, 11)])
def test_a_black_sheet_is_another_colour(session, rgb):
    session.color = rgb
    assert reasons(session.run(10)) == [LostReason.SURFACE_CHANGED] * 10
    session.color = (150, 140, 120)
    assert session.run(10)[SOON:] == [None] * (10 - SOON)


def test_a_picture_that_darkens_as_a_whole_is_no_black_sheet(session, monkeypatch):
    for dimming in (0.3, 0.1):
        dark = (picture(session.color) * dimming).astype(np.uint8)
        monkeypatch.setattr(sys.modules[__name__], "picture", lambda _rgb, dark=dark: dark)
        assert session.run(10) == [None] * 10


def test_each_comparison_states_whether_it_could_be_made(session):
    session.run(1)
    assert session.check.evidence == Evidence(surface=True, color=True, camera=True, colored_share=1.0)
    session.has_depth = False
    session.run(SOON)
    assert session.check.evidence == Evidence(surface=False, color=True, camera=False, colored_share=1.0)
    session.has_depth, session.has_room = True, False
    session.run(SOON)
    assert session.check.evidence == Evidence(surface=True, color=True, camera=False, colored_share=1.0)
    session.run(1, is_reference_due=True)
    session.has_room = True
    session.run(2)
    assert not session.check.evidence.camera  # it is learned for a second
    session.run(FRAMES)
    assert session.check.evidence.camera
    session.check.restart()
    assert session.check.evidence is None


@pytest.mark.parametrize("is_dark_before", [False, True])
@pytest.mark.parametrize(("dark_px", "is_compared"), [(70, True), (95, False)])
def test_the_colour_is_compared_where_half_of_the_region_has_one(
    session, monkeypatch, dark_px, is_compared, is_dark_before
):
    """In the dark now, or when the reference was set: a strip of the region's 160 px in width."""
    color = picture(session.color).copy()
    color[:, 240 : 240 + dark_px] = 5
    with monkeypatch.context() as patch:
        patch.setattr(sys.modules[__name__], "picture", lambda _rgb: color)
        session.run(2, is_reference_due=is_dark_before)
    if is_dark_before:
        session.run(1)
    assert session.check.evidence.color is is_compared
    assert session.check.evidence.colored_share == pytest.approx(1.0 - dark_px / 160.0, abs=0.06)


@pytest.mark.parametrize(("cells", "is_compared"), [(20, True), (19, False)])
def test_the_surface_is_compared_by_twenty_cells(session, cells, is_compared):
    session.cells_seen = cells
    session.run(SOON)
    assert session.check.evidence.surface is is_compared


def test_an_object_that_shrinks_is_one_until_it_is_clearly_smaller_than_its_limit(session, monkeypatch):
    """A height of 54 px is 5.7 % of the region: too little for an object by itself, enough for one that was found."""

    def losses_with(height_px):
        color = picture((150, 140, 120)).copy()
        color[140 : 140 + height_px, 280:320] = (90, 130, 120)
        with monkeypatch.context() as patch:
            patch.setattr(sys.modules[__name__], "picture", lambda _rgb: color)
            return reasons(session.run(3))

    lost = LostReason.SURFACE_CHANGED
    found = [losses_with(height_px)[-1] for height_px in (54, 104, 54, 36, 54)]
    assert found == [None, lost, lost, None, None]


def test_a_patient_raised_within_a_deeper_breath_is_so_but_for_a_share_of_it(session):
    """At the end of inhale, where such a breath explains most of a height."""
    session.depth = 2.0
    while math.cos(1.5 * session.index * STEP_US / 1e6) > -0.99:
        session.run(1)
    session.raised_mm = 8.0
    session.run(SOON)
    assert 3.0 < session.check.position.height_mm < 8.0


@pytest.mark.parametrize("camera_mm", [-4.0, 3.0])
def test_a_camera_that_moved_is_named_although_all_that_it_sees_moves_alike(session, camera_mm):
    session.camera_mm = camera_mm
    losses = session.run(40)
    assert reasons(losses[SOON:]) == [LostReason.CAMERA_MOVED] * (40 - SOON)
    assert f"{abs(camera_mm):.0f}." in losses[-1].detail or f"{abs(camera_mm) - 0.1:.1f}" in losses[-1].detail


@pytest.mark.parametrize("raised_mm", [-4.0, 2.5])
def test_a_patient_who_moved_as_a_whole_is_measured_and_their_height_known(session, raised_mm):
    session.raised_mm = raised_mm
    assert session.run(40) == [None] * 40
    assert session.check.position.height_mm == pytest.approx(raised_mm, abs=0.6)
    assert abs(session.check.position.roll_deg) < 0.2


@pytest.mark.parametrize("edge_mm", [-3.0, 3.0])
@pytest.mark.parametrize("way", ["inferior_mm", "left_mm"])
def test_a_patient_who_is_tilted_is_measured_in_degrees_over_the_region_s_size(session, way, edge_mm):
    """The markers are 850 mm away; the lever is from one edge of the region to the other."""
    setattr(session, way, edge_mm)
    session.run(40)
    across_mm, along_mm, _ = 850.0 * (MARKER_RAYS[2] - MARKER_RAYS[0])
    lever_mm = along_mm if way == "inferior_mm" else across_mm
    expected = math.degrees(math.atan(2.0 * edge_mm / lever_mm))
    found = session.check.position
    tilt_deg, roll_deg = (expected, 0.0) if way == "inferior_mm" else (0.0, expected)
    assert found.tilt_deg == pytest.approx(tilt_deg, abs=0.25)
    assert found.roll_deg == pytest.approx(roll_deg, abs=0.25)


def test_a_camera_that_moved_stays_lost_while_couch_and_floor_are_hidden(session):
    session.camera_mm = 4.0
    session.run(20)
    session.has_room = False
    assert reasons(session.run(20)) == [LostReason.CAMERA_MOVED] * 20


@pytest.mark.parametrize("sheet_mm", [0.0, 3.0])
def test_what_was_found_stands_while_the_surface_is_hidden(session, sheet_mm):
    session.sheet_mm, session.raised_mm = sheet_mm, -4.0
    session.run(20)
    height_mm, measured_us = session.check.position.height_mm, session.check.position.measured_us
    session.has_depth = False
    session.run(1)
    hidden_us = session.check.position.measured_us
    hidden = reasons(session.run(20))
    assert session.check.position is not None
    assert session.check.position.measured_us == hidden_us <= measured_us + 1e6 / 30
    assert session.check.position.height_mm == pytest.approx(height_mm, abs=0.5)
    assert hidden == [LostReason.SURFACE_CHANGED if sheet_mm else None] * 20


def test_another_colour_stays_lost_while_it_is_too_dark_to_see(session):
    session.color = (62, 112, 98)
    session.run(5)
    session.color = (5, 5, 5)
    assert reasons(session.run(5)) == [LostReason.SURFACE_CHANGED] * 5


def test_a_lowered_patient_stays_low_within_deeper_breaths(session):
    session.raised_mm = -4.0
    session.run(40)
    session.depth = 2.0
    heights = []
    for _ in range(120):
        session.run(1)
        heights.append(session.check.position.height_mm)
    assert max(heights) < -3.0


def test_a_deeper_breath_that_lifts_all_alike_is_no_movement_of_the_patient(session):
    session.depth, session.has_shoulders = 2.5, True
    for _ in range(120):
        session.run(1)
        assert abs(session.check.position.height_mm) < 1.5


def test_the_scene_is_learned_as_soon_as_the_surface_is_seen(session):
    session.has_depth = False
    session.run(FRAMES + 5, is_reference_due=True)
    session.has_depth = True
    session.run(FRAMES + 20)
    session.camera_mm = 4.0
    assert reasons(session.run(20))[-1] == LostReason.CAMERA_MOVED


def test_the_position_needs_no_skin_beside_a_marker(session):
    session.raised_mm = -4.0
    session.hidden_corner = True
    session.run(20)
    assert session.check.position.height_mm == pytest.approx(-4.0, abs=0.6)


def test_a_new_reference_accepts_what_a_person_has_seen(session):
    session.sheet_mm, session.raised_mm, session.color = 3.0, 4.0, (62, 112, 98)
    assert session.run(20)[-1] is not None
    assert session.run(FRAMES + 20, is_reference_due=True) == [None] * (FRAMES + 20)
    assert abs(session.check.position.height_mm) < 0.6


def test_a_new_model_without_a_new_reference_changes_nothing(session):
    session.sheet_mm = 3.0
    session.run(20)
    for _ in range(150):
        session.observe()
        session.check.gather()
    session.model = stored_model()
    assert reasons(session.run(1)) == [LostReason.SURFACE_CHANGED]


@pytest.mark.parametrize("more", [0, 1])
def test_shapes_learned_ahead_are_those_of_all_that_was_gathered(more, monkeypatch):
    """A training job learns them; what is gathered after that makes the measuring thread learn them again."""
    learned = []
    monkeypatch.setattr(
        cell_surface, "learn_shapes", lambda cells_mm: learned.append(cells_mm) or learn_shapes(cells_mm)
    )
    found, alone = Session(), Session()
    for number in range(80 + more):
        for session in (found, alone):
            session.observe()
            session.check.gather()
        if number == 79:
            found.learned = found.check.gathered.learn()
    found.run(1)
    assert [len(cells_mm) for cells_mm in learned] == [80, *[81] * more]
    alone.run(1)
    assert np.array_equal(found.check.shapes.terms, alone.check.shapes.terms, equal_nan=True)
    assert found.check.shapes.misfit_mm == alone.check.shapes.misfit_mm


def test_a_reference_set_on_the_first_frame_is_no_noisier_than_a_later_one(learned):
    found = deepcopy(learned)
    found.check.restart()
    assert found.run(150) == [None] * 150
    reference = found.check._reference
    assert len(reference.surfaces_mm) == AVERAGED_US // STEP_US + 1
    assert np.abs(reference.cells_mm - np.mean(reference.surfaces_mm, axis=0)).max() < 1e-6


def test_what_is_lost_for_another_reason_is_no_part_of_the_reference(learned):
    found = deepcopy(learned)
    found.check.restart()
    found.run(2)
    found.sheet_mm, found.is_lost_otherwise = 5.0, True
    found.run(20)
    found.sheet_mm, found.is_lost_otherwise = 0.0, False
    assert found.run(40)[SOON:] == [None] * (40 - SOON)
    assert np.abs(found.check._reference.cells_mm - np.mean(found.check._reference.surfaces_mm, axis=0)).max() < 1e-6
    assert len(found.check._reference.surfaces_mm) < 4


def test_a_restart_forgets_the_reference(session):
    session.sheet_mm = 3.0
    session.run(20)
    session.check.restart()
    assert session.check.position is None
    assert session.run(20) == [None] * 20


@pytest.mark.parametrize(
    ("redistributed_mm", "is_lost"),
    [(0.0, True), (1.0, True), (2.5, False)],
    ids=["breath", "thin cover", "held breath"],
)
def test_what_a_held_breath_shifts_to_the_thorax_is_allowed_beside_the_misfit_and_a_thin_cover_is_not(
    redistributed_mm, is_lost
):
    """A breath hold on a sensor with pixel locking left 0.32 mm beside 2.4 mm that were shifted."""
    check = CrossCheck(calibration())
    shapes = np.zeros((2, cell_surface.CELLS))
    check.shapes = cell_surface.BreathingShapes(shapes=shapes, misfit_mm=0.154, reach_mm=7.5)
    check._position = lambda *_: None  # where the patient lies is not asked here
    misfit_mm = np.full(cell_surface.CELLS, 0.32)
    change = cell_surface.SurfaceChange(0.0, 0.0, 0.0, 5.9, redistributed_mm, misfit_mm, 0.32)
    assert (check._surface_changed(change) is not None) is is_lost


@pytest.mark.parametrize(("moved_mm", "is_named"), [(1.5, False), (1.51, True)])
def test_the_bound_of_a_moved_camera_is_a_millimetre_and_a_half_itself(moved_mm, is_named):
    """The pictures above have whole millimetres; the mean of the scene has not."""
    assert (CrossCheck(calibration())._camera_moved(moved_mm) is not None) is is_named


@pytest.mark.parametrize(
    ("trained_mm", "now_mm", "allowed_mm"), [(10.0, 10.0, 0.6), (0.2, 0.2, 0.34), (0.35, 0.14, 0.25)]
)
def test_a_surface_may_differ_by_what_noise_of_now_explains_and_by_six_tenths_at_most(trained_mm, now_mm, allowed_mm):
    check = CrossCheck(calibration())
    shapes = np.zeros((2, cell_surface.CELLS))
    check.shapes = cell_surface.BreathingShapes(shapes=shapes, misfit_mm=trained_mm, reach_mm=7.5)
    check._model = SimpleNamespace(noise_mm=trained_mm)
    check.noise = SimpleNamespace(share_of=lambda trained: now_mm / trained)
    check._position = lambda *_: None
    for spread_mm, is_lost in ((allowed_mm - 0.01, False), (allowed_mm + 0.01, True)):
        misfit_mm = np.full(cell_surface.CELLS, spread_mm)
        change = cell_surface.SurfaceChange(0.0, 0.0, 0.0, 5.9, 0.0, misfit_mm, spread_mm)
        check._disagreements = {}
        assert (check._surface_changed(change) is not None) is is_lost
