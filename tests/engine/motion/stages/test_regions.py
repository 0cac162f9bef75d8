"""Named polygons, and the line between thorax and abdomen: exact coverage, means of what lies inside, refusals."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from engine.core.errors import InvalidValueError
from engine.core.frames import ROI_COLUMNS, ROI_ROWS
from engine.motion.named_regions import MAX_REGIONS, NamedRegion, coverage, enclosed_px
from engine.motion.settings import PipelineSettings
from engine.motion.stages.regions import RegionLayout, prepare_regions, region_values, thorax_coverage

ROWS, COLUMNS = np.mgrid[0:ROI_ROWS, 0:ROI_COLUMNS].astype(np.float64)
EDGES = ((-0.5, -0.5), (-0.5, 199.5), (349.5, 199.5), (349.5, -0.5))
TRIANGLE = ((20.0, 30.0), (180.25, 160.5), (240.0, 12.75))
ARROW = ((40.0, 40.0), (200.0, 100.0), (40.0, 160.0), (110.0, 100.0))  # concave


def region(vertices, name="belly"):
    return NamedRegion(name=name, vertices=tuple((float(row), float(column)) for row, column in vertices))


def supersampled(vertices, times=16):
    """Coverage by counting sub-pixel centres: the plain way, right to about one over ``times``."""
    offsets = (np.arange(times) + 0.5) / times - 0.5
    rows = (np.arange(ROI_ROWS)[:, None] + offsets).ravel()
    columns = (np.arange(ROI_COLUMNS)[:, None] + offsets).ravel()
    inside = np.zeros((rows.size, columns.size), dtype=bool)
    for (r0, c0), (r1, c1) in zip(vertices, [*vertices[1:], vertices[0]], strict=True):
        if r0 == r1:
            continue
        crosses = ((rows >= r0) != (rows >= r1))[:, None]
        inside ^= crosses & (columns < (c0 + (rows[:, None] - r0) * (c1 - c0) / (r1 - r0)))
    return inside.reshape(ROI_ROWS, times, ROI_COLUMNS, times).mean(axis=(1, 3))


@pytest.mark.parametrize("vertices", [TRIANGLE, ARROW, EDGES], ids=["triangle", "arrow", "whole grid"])
def test_a_pixel_counts_by_the_share_of_it_that_lies_inside(vertices):
    exact = coverage(vertices)
    assert exact.sum() == pytest.approx(enclosed_px(vertices), rel=1e-9)
    assert np.abs(exact - supersampled(vertices)).max() < 0.06


def test_the_way_around_makes_no_difference():
    assert np.allclose(coverage(ARROW), coverage(ARROW[::-1]), atol=1e-9)


def test_whole_pixels_are_covered_wholly_and_no_others_at_all():
    inside = coverage(((9.5, 19.5), (9.5, 39.5), (29.5, 39.5), (29.5, 19.5)))
    assert np.array_equal(inside, (ROWS >= 10) & (ROWS < 30) & (COLUMNS >= 20) & (COLUMNS < 40))


@settings(max_examples=60, deadline=None)
@given(
    angles=st.lists(st.floats(0.0, 0.99), min_size=3, max_size=64),
    center=st.tuples(st.floats(60.0, 290.0), st.floats(60.0, 140.0)),
    seed=st.integers(0, 1000),
)
def test_any_star_around_a_centre_covers_its_own_area_and_keeps_its_own_mean(angles, center, seed):
    # One vertex in each equal sector: a star, so simple by construction.
    count = max(len(angles), 5)
    share = np.resize(np.array(angles), count)
    turn = 2.0 * math.pi * (np.arange(count) + 0.8 * share) / count
    radius = np.random.default_rng(seed).uniform(12.0, 55.0, count)
    star = region(np.column_stack([center[0] + radius * np.sin(turn), center[1] + radius * np.cos(turn)]))
    inside = coverage(star.vertices)
    assert inside.sum() == pytest.approx(enclosed_px(star.vertices), rel=1e-7)
    plane = 850.0 + 0.1 * ROWS - 0.05 * COLUMNS
    layout = RegionLayout(named=(star,))
    mean = region_values(plane[None], layout)[0, -1]
    assert mean == pytest.approx((plane * inside).sum() / inside.sum(), rel=1e-9)


def test_the_mean_of_a_plane_over_a_triangle_is_its_height_at_the_centroid():
    centroid = np.mean(TRIANGLE, axis=0)
    plane = 850.0 + 0.3 * ROWS - 0.2 * COLUMNS
    mean = region_values(plane[None], RegionLayout(named=(region(TRIANGLE),)))[0, -1]
    # Pixels stand for their centres, so a rim pixel's part is read at the pixel's middle and not at the part's.
    assert mean == pytest.approx(850.0 + 0.3 * centroid[0] - 0.2 * centroid[1], abs=0.01)


def test_a_polygon_of_a_cells_edges_is_that_cell_and_one_of_all_edges_the_whole():
    surface = np.random.default_rng(3).uniform(800.0, 900.0, (1, ROI_ROWS, ROI_COLUMNS))
    cell = region(((24.5, 49.5), (24.5, 74.5), (49.5, 74.5), (49.5, 49.5)), "cell")
    values = region_values(surface, RegionLayout(named=(cell, region(EDGES, "everything"))))[0]
    assert values[-2] == pytest.approx(values[1 * 8 + 2], abs=1e-9)
    assert values[-1] == pytest.approx(values[14 * 8], abs=1e-9)


def test_named_regions_come_last_and_in_the_order_given():
    surface = ROWS[None].copy()
    low, high = region(((250, 20), (250, 60), (300, 60)), "low"), region(((20, 20), (20, 60), (60, 60)), "high")
    values = region_values(surface, RegionLayout(points=((7, 7),), named=(low, high)))[0]
    assert values[-3] == 7.0
    assert values[-2] > 250.0
    assert values[-1] < 60.0


def test_a_region_that_was_hardly_seen_is_empty_not_zero():
    known = np.ones((ROI_ROWS, ROI_COLUMNS), dtype=bool)
    known[:, :60] = False
    modes = np.zeros((1, ROI_ROWS, ROI_COLUMNS))
    seen, unseen = region(((20, 80), (20, 160), (90, 120)), "seen"), region(((20, 5), (20, 62), (90, 30)), "unseen")
    means = prepare_regions(np.full(known.shape, 850.0), modes, known, RegionLayout(named=(seen, unseen)))
    depth = means.depth_mm(np.zeros(1))[means.ends[2] :]
    assert depth[0] == pytest.approx(850.0)
    assert np.isnan(depth[1])


def test_of_a_region_as_small_as_a_cell_every_pixel_has_to_be_known():
    known = np.ones((ROI_ROWS, ROI_COLUMNS), dtype=bool)
    known[100, 100] = False
    tiny = region(((99.5, 99.5), (99.5, 104.5), (104.5, 104.5), (104.5, 99.5)), "tiny")
    means = prepare_regions(
        np.full(known.shape, 850.0), np.zeros((1, *known.shape)), known, RegionLayout(named=(tiny,))
    )
    assert np.isnan(means.depth_mm(np.zeros(1))[-1])


@pytest.mark.parametrize(
    ("vertices", "bound"),
    [
        (((0, 0), (0, 50)), "3 to 64"),
        ([(100 + 40 * math.sin(t), 100 + 40 * math.cos(t)) for t in np.arange(65) / 65 * 6.28], "3 to 64"),
        (((0, 0), (0, 200), (50, 50)), "inside the grid"),
        (((0, 0), (-0.6, 100), (50, 50)), "inside the grid"),
        (((0, 0), (math.nan, 100), (50, 50)), "inside the grid"),
        (((0, 0), (math.inf, 100), (50, 50)), "inside the grid"),
        (((10, 10), (60, 60), (10, 60), (60, 10)), "simple polygon"),  # a bow tie
        (((10, 10), (10, 60), (10, 30), (60, 30)), "simple polygon"),  # folds back upon itself
        (((10, 10), (10, 10), (10, 60), (60, 30)), "simple polygon"),  # a vertex twice
        (((10, 10), (10, 60), (60, 60), (10, 30), (60, 10)), "simple polygon"),  # a vertex on another edge
        (((10, 10), (10, 60), (60, 60), (10, 10), (60, 5)), "simple polygon"),  # a vertex come back to
        (((10, 10), (10, 14), (14, 14)), "at least 25 pixels"),
        (((10, 10), (10, 60), (10.0001, 30)), "at least 25 pixels"),
    ],
)
def test_what_is_no_region_is_refused_by_name_value_and_bound(vertices, bound):
    with pytest.raises(InvalidValueError, match=rf"region belly is .*{bound}"):
        region(vertices)


@pytest.mark.parametrize(
    "name",
    ["", "Belly", "9th", "a b", "x" * 33, "whole", "thorax", "abdomen", "p10_20", "_a", "belly\n", "bauch-links"],
)
def test_a_name_that_could_be_mistaken_is_refused(name):
    with pytest.raises(InvalidValueError, match="region is"):
        region(TRIANGLE, name)


def test_as_many_regions_as_may_be_and_no_name_twice():
    many = tuple(region(TRIANGLE, f"r{i}") for i in range(MAX_REGIONS + 1))
    assert len(RegionLayout(named=many[:-1]).named) == MAX_REGIONS
    with pytest.raises(InvalidValueError, match=f"at most {MAX_REGIONS}"):
        RegionLayout(named=many)
    with pytest.raises(InvalidValueError, match="names must be unique"):
        RegionLayout(named=(many[0], many[0]))


@pytest.mark.parametrize(
    ("vertices", "is_simple"), [(TRIANGLE, True), (ARROW, True), (EDGES, True), ([*TRIANGLE[:2], (21, 31)], False)]
)
def test_a_polygon_agrees_with_opencvs_area(vertices, is_simple):
    points = np.array(vertices, dtype=np.float32)
    assert enclosed_px(tuple(map(tuple, vertices))) == pytest.approx(cv2.contourArea(points), rel=1e-5)


# -- thorax and abdomen -------------------------------------------------------------------------------------------


def test_the_default_line_lies_between_rows_174_and_175():
    assert np.array_equal(thorax_coverage(PipelineSettings().layout().split), ROWS < 175)
    assert np.array_equal(thorax_coverage(PipelineSettings(thorax_rows=150).layout().split), ROWS < 150)


def test_a_slanted_line_cuts_where_it_states():
    split = (120.0, 220.0)
    thorax = thorax_coverage(split)
    line = 120.0 + 100.0 * COLUMNS / 199.0
    assert np.all(thorax[line > ROWS + 1.0] == 1.0)
    assert np.all(thorax[line < ROWS - 1.0] == 0.0)
    # Through a pixel's centre: half of it, whatever the slope.
    assert thorax[120, 0] == pytest.approx(0.5)
    assert thorax[220, 199] == pytest.approx(0.5)
    assert thorax.sum() == pytest.approx(200.0 * (170.0 + 0.5))


def test_parts_are_means_of_their_sides_and_add_up_to_the_whole():
    surface = np.random.default_rng(5).uniform(800.0, 900.0, (1, ROI_ROWS, ROI_COLUMNS))
    split = (140.0, 190.0)
    whole, thorax, abdomen = region_values(surface, RegionLayout(split=split))[0, 14 * 8 : 14 * 8 + 3]
    share = thorax_coverage(split).mean()
    assert whole == pytest.approx(share * thorax + (1.0 - share) * abdomen)
    assert thorax == pytest.approx((surface[0] * thorax_coverage(split)).sum() / thorax_coverage(split).sum())


@pytest.mark.parametrize("split", [(34.0, 100.0), (100.0, 316.0), (math.nan, 100.0)])
def test_a_line_that_leaves_a_part_next_to_nothing_is_refused(split):
    with pytest.raises(InvalidValueError, match=r"split is .*rows 35 to 315"):
        PipelineSettings(split=split)
