"""A change of the region's colour is found; one of brightness or of the white balance is not."""

import numpy as np
import pytest

from engine.motion.cross_check import appearance
from engine.motion.cross_check.appearance import AROUND, brightness_of, color_change

MARKERS_PX = np.array([[200.0, 100.0], [440.0, 110.0], [430.0, 380.0], [210.0, 370.0]])
SKIN, SHEET = (190.0, 140.0, 120.0), (62.0, 112.0, 98.0)


DARK_SHIRT, SHEET_OF_ITS_HUE = (22.0, 47.0, 38.0), (60.0, 115.0, 98.0)


def picture(*, sheet=None, gain=(1.0, 1.0, 1.0), seed=1, skin=SKIN, sheet_color=SHEET):
    """A patient in front of a grey couch; ``sheet`` are the rows that a sheet covers."""
    color = np.full((480, 640, 3), 150.0)
    color[80:400, 180:460] = skin
    if sheet is not None:
        color[sheet, 180:460] = sheet_color
    noise = np.random.default_rng(seed).normal(0.0, 4.0, color.shape)
    return np.clip(color * gain + noise, 0.0, 255.0).astype(np.uint8)


def chroma_of(color, markers_px):
    return appearance.chroma_of(color, markers_px, color[::16, ::16])


BEFORE = chroma_of(picture(), MARKERS_PX)


def share(color, markers_px=MARKERS_PX):
    return changed(BEFORE, chroma_of(color, markers_px))


def changed(before, now):
    return color_change(before, now, before.copy()).changed_share


def test_a_sheet_changes_its_share_of_the_region():
    assert share(picture(sheet=slice(240, 400), seed=2)) == pytest.approx(0.5, abs=0.08)
    assert share(picture(sheet=slice(80, 400), seed=2)) > 0.95


def test_a_sheet_of_nearly_the_shirts_hue_is_found_by_the_blocks_that_it_covers():
    """Each cell changes by less than noise may change one; noise never changes half of a block in one direction."""
    before = chroma_of(picture(skin=DARK_SHIRT), MARKERS_PX)
    for rows, covered in ((slice(80, 400), 1.0), (slice(240, 400), 0.5)):
        after = picture(sheet=rows, seed=2, skin=DARK_SHIRT, sheet_color=SHEET_OF_ITS_HUE)
        assert changed(before, chroma_of(after, MARKERS_PX)) == pytest.approx(covered, abs=0.12)
    assert changed(before, chroma_of(picture(seed=3, skin=DARK_SHIRT), MARKERS_PX)) < 0.01


@pytest.mark.parametrize("gain", [(1.0, 1.0, 1.0), (0.6, 0.6, 0.6), (1.2, 1.2, 1.2), (1.1, 1.0, 0.9)])
def test_noise_brightness_and_white_balance_change_nothing(gain):
    assert share(picture(gain=gain, seed=3)) < 0.01


def test_the_lines_of_positioning_lasers_that_wander_are_no_object():
    before, after = picture(seed=5), picture(seed=6)
    for color, row, column in ((before, 200, 300), (after, 212, 320)):
        color[row : row + 5, :] = (250, 60, 50)
        color[:, column : column + 5] = (250, 60, 50)
    assert changed(chroma_of(before, MARKERS_PX), chroma_of(after, MARKERS_PX)) < 0.03


def test_a_patient_who_moves_takes_the_region_along():
    moved = np.roll(picture(seed=4), (12, 9), axis=(0, 1))
    assert share(moved, MARKERS_PX + np.array([9.0, 12.0])) < 0.01


def test_what_is_too_dark_has_no_colour():
    dark = np.zeros((480, 640, 3), dtype=np.uint8)
    assert changed(chroma_of(dark, MARKERS_PX), BEFORE) == 0.0
    assert changed(BEFORE, chroma_of(dark, MARKERS_PX)) == 0.0


def test_an_infrared_picture_has_no_colour_to_compare_however_bright_it_is():
    gray = np.repeat(picture()[..., :1], 3, axis=2)
    assert np.isnan(chroma_of(gray, MARKERS_PX)).all()
    gray[240, 320, 1] += 1  # one pixel that differs by chance makes no colour picture of it
    assert np.isnan(chroma_of(gray, MARKERS_PX)).all()
    assert np.isfinite(chroma_of(picture(skin=(150.0, 150.0, 150.0)), MARKERS_PX)).all()


def test_what_is_dark_now_keeps_the_colour_that_it_had_last():
    newest, sheet = BEFORE.copy(), chroma_of(picture(sheet=slice(240, 400), seed=2), MARKERS_PX)
    covered = color_change(BEFORE, sheet, newest).changed_share
    assert covered == pytest.approx(0.5, abs=0.08)
    assert color_change(BEFORE, np.full_like(sheet, np.nan), newest).changed_share == covered
    assert color_change(BEFORE, BEFORE, newest).changed_share == 0.0


def test_brightness_is_that_of_the_cells_and_of_the_near_surroundings():
    """The region, the ring around it of a share of its size, and what is farther away are three greys."""
    left, top, right, bottom = 200, 112, 440, 368
    markers_px = np.array([[left, top], [right, top], [right, bottom], [left, bottom]], dtype=np.float64)
    beside, above = AROUND * (right - left), AROUND * (bottom - top)
    y, x = np.mgrid[0:480, 0:640]
    color = np.full((480, 640), 10, dtype=np.uint8)
    ring = (y >= top - above) & (y <= bottom + above) & (x >= left - beside) & (x <= right + beside)
    color[ring] = 200
    for grey, side in ((230, x < left), (170, x > right), (240, y < top), (160, y > bottom)):
        color[ring & side] = grey  # opposite sides make up for each other
    inside = (y >= top) & (y <= bottom) & (x >= left) & (x <= right)
    color[inside] = 40 + (x[inside] - left) // 24 + 10 * ((y[inside] - top) // 64)
    found = brightness_of(np.repeat(color[:, :, None], 3, axis=2), markers_px)
    assert found.around == pytest.approx(600.0, abs=3.0)
    columns, rows = np.meshgrid((12.0 * np.arange(20) + 5.7) // 24, (7.3 * np.arange(35) + 3.0) // 64)
    assert np.abs(found.cells / 3.0 - (40 + columns + 10 * rows).ravel()).max() <= 10.0
    assert np.median(np.abs(found.cells / 3.0 - (40 + columns + 10 * rows).ravel())) == 0.0
    whole = brightness_of(
        np.full((480, 640, 3), 90, dtype=np.uint8), np.array([[0, 0], [639, 0], [639, 479], [0, 479]])
    )
    assert (set(whole.cells), whole.around) == ({270.0}, 0.0), "nothing lies around a region that fills the picture"
