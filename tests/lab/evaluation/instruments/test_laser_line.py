"""The line in pictures drawn line by line: to hundredths of a pixel, and nowhere but where a line is."""

import numpy as np
import pytest

from lab.evaluation.instruments.laser_line import LineSettings, find_line

SHAPE = (120, 160)
EVERYWHERE = np.ones(SHAPE, dtype=bool)


def picture(rows, *, sigma_px=1.3, red=190.0, leak=0.08, ground=(40.0, 46.0, 60.0), noise=0.0):
    """A dark shirt with a red line whose middle is at ``rows[column]``."""
    away = np.arange(SHAPE[0])[:, None] - np.asarray(rows, dtype=float)
    profile = np.exp(-0.5 * (away / sigma_px) ** 2)
    drawn = np.array(ground) + profile[..., None] * np.array([red, leak * red, leak * red])
    drawn += np.random.default_rng(1).normal(0.0, noise, drawn.shape) if noise else 0.0
    return np.clip(np.rint(drawn), 0, 255).astype(np.uint8)


def rows_of(line):
    found = np.full(SHAPE[1], np.nan)
    found[line.pixels_px[:, 0].astype(int)] = line.pixels_px[:, 1]
    return found


SLANTED = 50.0 + 0.15 * np.arange(SHAPE[1])


def test_a_line_is_found_to_hundredths_of_a_pixel_wherever_it_lies_between_pixels():
    line = find_line(picture(SLANTED), EVERYWHERE)
    # Beyond the picture's sides there is nothing to smooth with.
    error = (rows_of(line) - SLANTED)[1:-1]
    assert len(line.pixels_px) > 150
    assert np.nanmax(np.abs(error)) < 0.03
    assert abs(np.nanmean(error)) < 0.01
    assert line.contrast.min() > 100


def test_a_line_that_burns_out_in_red_alone_keeps_its_middle():
    error = rows_of(find_line(picture(SLANTED, red=420.0, leak=0.2), EVERYWHERE)) - SLANTED
    assert np.isfinite(error).sum() > 150
    assert np.nanmax(np.abs(error)) < 0.08


def test_noise_costs_a_few_hundredths_of_a_pixel():
    error = rows_of(find_line(picture(SLANTED, noise=4.0), EVERYWHERE)) - SLANTED
    assert np.nanstd(error) < 0.06


def test_a_line_up_and_down_the_picture_is_found_along_rows():
    upright = picture(SLANTED).transpose(1, 0, 2).copy()
    line = find_line(upright, EVERYWHERE.T, is_upright=True)
    assert line.pixels_px[:, ::-1] == pytest.approx(find_line(picture(SLANTED), EVERYWHERE).pixels_px)


def test_a_white_sticker_is_no_line_though_its_red_is_the_brightest():
    drawn = picture(SLANTED)
    drawn[20:36, 60:76] = (250, 249, 246)
    found = rows_of(find_line(drawn, EVERYWHERE))
    assert np.nanmax(np.abs(found - SLANTED)) < 0.1
    assert np.isfinite(found[60:76]).all()


def test_a_line_across_a_white_sticker_is_left_out_there_and_nowhere_else():
    drawn = picture(SLANTED).astype(float)
    drawn[50:72, 60:76] = np.clip(drawn[50:72, 60:76] + 205.0, 0, 255)
    found = rows_of(find_line(drawn.astype(np.uint8), EVERYWHERE))
    assert np.isnan(found[62:74]).all()
    assert np.isfinite(found[:55]).mean() > 0.95
    assert np.isfinite(found[82:]).mean() > 0.95


def test_a_line_whose_core_burns_out_to_white_is_left_out():
    drawn = picture(SLANTED).astype(float)
    burnt = picture(SLANTED, red=900.0, leak=0.6, sigma_px=2.0)
    drawn[:, 60:100] = burnt[:, 60:100]
    found = rows_of(find_line(drawn.astype(np.uint8), EVERYWHERE))
    assert np.isnan(found[63:97]).all()
    assert np.isfinite(found[:57]).mean() > 0.95


def test_skin_and_a_picture_without_a_line_hold_none():
    skin = np.full((*SHAPE, 3), (214, 168, 142), dtype=np.uint8)
    shirt = picture(np.full(SHAPE[1], -50.0), noise=4.0)
    assert len(find_line(skin, EVERYWHERE).pixels_px) == 0
    assert len(find_line(shirt, EVERYWHERE).pixels_px) == 0


def test_two_lines_alike_are_ambiguous_and_so_neither_is_taken():
    double = np.maximum(picture(SLANTED), picture(SLANTED + 30.0, red=150.0))
    assert len(find_line(double, EVERYWHERE).pixels_px) == 0
    weak = np.maximum(picture(SLANTED), picture(SLANTED + 30.0, red=60.0))
    assert np.nanmax(np.abs(rows_of(find_line(weak, EVERYWHERE)) - SLANTED)) < 0.1


def test_a_red_speck_beside_a_gap_of_the_line_is_a_stray():
    drawn = picture(SLANTED)
    drawn[:, 80:84] = (40, 46, 60)
    drawn[20:23, 80:84] = (220, 60, 60)
    found = rows_of(find_line(drawn, EVERYWHERE))
    assert np.isnan(found[81:83]).all()


def test_nothing_is_looked_for_outside_of_the_region():
    region = np.zeros(SHAPE, dtype=bool)
    region[:, 40:90] = True
    columns = find_line(picture(SLANTED), region).pixels_px[:, 0]
    assert (columns.min(), columns.max()) == (40, 89)
    above = np.zeros(SHAPE, dtype=bool)
    above[:30] = True
    assert len(find_line(picture(SLANTED), above).pixels_px) == 0
    assert len(find_line(picture(SLANTED), np.zeros(SHAPE, dtype=bool)).pixels_px) == 0


def test_a_line_at_the_very_edge_of_the_picture_breaks_nothing():
    line = find_line(picture(np.full(SHAPE[1], 0.0)), EVERYWHERE)
    assert np.isfinite(line.pixels_px).all()
    tiny = np.zeros(SHAPE, dtype=bool)
    tiny[0, 0] = True
    assert len(find_line(picture(SLANTED), tiny, settings=LineSettings()).pixels_px) == 0
