import numpy as np
import pytest

from engine.core.errors import InvalidValueError
from lab.phantom.anatomy import TRUNK_HALF_MM, Anatomy
from lab.phantom.builds import BUILDS
from lab.phantom.truth import Skin

X_MM, Y_MM = np.meshgrid(np.arange(-TRUNK_HALF_MM[0], TRUNK_HALF_MM[0] + 1, 4), np.arange(-296.0, 297.0, 4))


@pytest.mark.parametrize("volunteer", [0, 11, -1, 1.0, True, "1", None])
def test_there_are_ten_volunteers_and_no_other(volunteer):
    with pytest.raises(InvalidValueError, match=r"volunteer is .*: must be a whole number from 1 to 10"):
        Anatomy(volunteer)


def test_no_two_volunteers_are_built_alike():
    heights = [Anatomy(volunteer).trunk_height(X_MM, Y_MM) for volunteer in range(1, 11)]
    for i, one in enumerate(heights):
        for other in heights[i + 1 :]:
            assert np.abs(one - other).mean() > 2.0
    assert (min(build.bmi for build in BUILDS), max(build.bmi for build in BUILDS)) == (19.3, 28.7)


def test_the_heavier_the_volunteer_the_higher_the_belly():
    bellies = [float(Anatomy(v).trunk_height(np.array(0.0), np.array(95.0))) for v in range(1, 11)]
    bmi = [build.bmi for build in BUILDS]
    assert np.corrcoef(bmi, bellies)[0, 1] > 0.9


@pytest.mark.parametrize("volunteer", range(1, 11))
def test_stickers_sit_on_the_trunk_in_the_order_of_the_corners(volunteer):
    anatomy = Anatomy(volunteer)
    (x1, y1), (x2, y2), (x3, y3), (x4, y4) = anatomy.anchors_mm
    assert x1 < 0 < x2
    assert x4 < 0 < x3
    assert max(y1, y2) < -150 < 150 < min(y3, y4)
    assert np.all(anatomy.side(*anatomy.anchors_mm.T) < 0.75)


@pytest.mark.parametrize("volunteer", range(1, 11))
def test_the_skin_is_still_where_the_moving_part_ends(volunteer):
    modes = Anatomy(volunteer).modes(X_MM, Y_MM)
    for edge in (modes[:, 0], modes[:, -1], modes[:, :, 0], modes[:, :, -1]):
        assert np.abs(edge).max() == 0.0
    assert 0.75 < modes[:3].sum(axis=0).max() <= 1.0
    assert 0.75 < modes[3:6].sum(axis=0).max() <= 1.3


def test_the_abdomen_moves_below_and_the_thorax_above():
    modes = Anatomy(1).modes(X_MM, Y_MM)
    middle = [float((part.sum(axis=0) * Y_MM).sum() / part.sum(axis=0).sum()) for part in (modes[:3], modes[3:6])]
    assert middle[0] > 50.0
    assert middle[1] < -70.0


def test_swept_volume_is_the_integral_of_what_the_skin_moved():
    anatomy = Anatomy(4)
    weights = np.array([3.0, 4.0, 2.0, 1.0, 2.0, 1.5, 0.3, 0.1])
    rng = np.random.default_rng(0)
    low, high = anatomy.anchors_mm.min(axis=0), anatomy.anchors_mm.max(axis=0)
    x, y = rng.uniform(low[0], high[0], 200_000), rng.uniform(low[1], high[1], 200_000)
    corners = anatomy.anchors_mm
    is_inside = np.ones(x.shape, bool)
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        is_inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0
    moved = (anatomy.modes(x, y) * weights[:, None]).sum(axis=0) * is_inside
    litres = moved.mean() * float(np.prod(high - low)) * 1e-6
    assert Skin(anatomy).volume_l(weights) == pytest.approx(litres, rel=0.01)
