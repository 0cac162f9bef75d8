"""The seen share of each region is by area, and does not count what the model extrapolates."""

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from engine.core.breath import SignalChoice
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, SeenShares
from engine.motion.learning.prepared_model import prepare_seen_weights
from engine.motion.named_regions import NamedRegion
from engine.motion.stages.projection import SAMPLED_SHAPE, STRIDE_PX
from engine.motion.stages.regions import RegionLayout, grid_shape, region_values

NEAREST = (
    np.minimum((np.arange(ROI_ROWS) + STRIDE_PX // 2) // STRIDE_PX, SAMPLED_SHAPE[0] - 1),
    np.minimum((np.arange(ROI_COLUMNS) + STRIDE_PX // 2) // STRIDE_PX, SAMPLED_SHAPE[1] - 1),
)
BELLY = NamedRegion(name="belly", vertices=((200.0, 20.0), (330.25, 90.5), (210.0, 180.0)))
LAYOUT = RegionLayout(points=((0, 0), (200, 100), (349, 199)), named=(BELLY,))
WEIGHTS = prepare_seen_weights(LAYOUT)
BLIND_FROM = 280


def blind_below(row=BLIND_FROM):
    seen = np.ones(SAMPLED_SHAPE, dtype=bool)
    seen[row // STRIDE_PX :] = False
    return seen


def test_all_seen_is_one_and_nothing_seen_is_zero():
    assert WEIGHTS.shares(np.ones(SAMPLED_SHAPE, dtype=bool)).tolist() == [1.0] * (14 * 8 + 3 + 3 + 1)
    assert not WEIGHTS.shares(np.zeros(SAMPLED_SHAPE, dtype=bool)).any()


@pytest.mark.parametrize("cell_px", [5, 6, 7, 25, 33, 99, 100])
def test_every_cell_of_every_size_has_the_share_of_its_own_area(cell_px):
    layout = RegionLayout(cell_px=cell_px, split=(150.0, 190.0), named=(BELLY,))
    seen = np.random.default_rng(cell_px).random(SAMPLED_SHAPE) < 0.7
    expected = region_values(seen[np.ix_(*NEAREST)][None].astype(np.float64), layout)[0]
    rows, columns = grid_shape(cell_px)
    shares = prepare_seen_weights(layout).shares(seen)
    assert shares.shape == (rows * columns + 4,)
    assert shares == pytest.approx(expected, abs=1e-4)


def test_a_point_has_the_share_of_its_surroundings_also_at_the_edges_of_the_grid():
    points = WEIGHTS.by_region(WEIGHTS.shares(blind_below(200))).points
    assert points[0] == 1.0
    assert points[1] == pytest.approx(8 / 21, abs=1e-4)  # of rows 190 to 210, 190 to 197 are nearest to seen samples
    assert points[2] == 0.0


def test_what_lies_below_a_blind_fifth_is_reported_by_name():
    shares = WEIGHTS.by_region(WEIGHTS.shares(blind_below()))
    assert shares.whole == pytest.approx(0.8, abs=0.01)
    assert shares.abdomen == pytest.approx(0.6, abs=0.02)
    assert shares.thorax == 1.0
    assert shares.cells.shape == (14, 8)
    assert (shares.cells[:11] == 1.0).all()
    assert not shares.cells[12:].any()
    assert SignalChoice(signal="region", row=12, column=4).seen_in(shares) == 0.0
    assert SignalChoice(signal="region", row=3, column=4).seen_in(shares) == 1.0
    assert SignalChoice(signal="point", row=349, column=199, index=2).seen_in(shares) == 0.0
    assert 0.5 < SignalChoice(signal="named", name="belly").seen_in(shares) < 1.0
    assert SignalChoice(signal="abdomen").seen_in(shares) == shares.abdomen
    assert SignalChoice().seen_in(shares) == SignalChoice(signal="volume").seen_in(shares) == shares.whole


def test_shares_of_several_frames_are_averaged():
    some = WEIGHTS.shares(np.mean([blind_below(), blind_below(ROI_ROWS + STRIDE_PX)], axis=0))
    assert some == pytest.approx(0.5 * (1.0 + WEIGHTS.shares(blind_below())), abs=1e-4)


@pytest.mark.parametrize(
    "choice",
    [
        SignalChoice(),
        SignalChoice(signal="volume"),
        SignalChoice(signal="abdomen"),
        SignalChoice(signal="region", row=0, column=0),
        SignalChoice(signal="point", row=0, column=0),
        SignalChoice(signal="named", name="belly"),
    ],
)
def test_an_absent_share_is_not_a_number(choice):
    assert math.isnan(choice.seen_in(SeenShares()))


@settings(max_examples=25, deadline=None)
@given(
    row=st.integers(0, 349),
    column=st.integers(0, 199),
    height=st.integers(0, 200),
    width=st.integers(0, 120),
    cell_px=st.sampled_from([10, 25, 60]),
)
def test_more_holes_never_raise_a_share(row, column, height, width, cell_px):
    weights = prepare_seen_weights(RegionLayout(cell_px=cell_px, points=((row, column),)))
    seen = np.random.default_rng(row).random(SAMPLED_SHAPE) < 0.8
    fewer = seen.copy()
    fewer[row // 4 : (row + height) // 4, column // 4 : (column + width) // 4] = False
    before, after = weights.shares(seen), weights.shares(fewer)
    assert (after <= before + 1e-4).all()
    assert ((before >= 0.0) & (before <= 1.0)).all()
