"""People who breathe as at the reference are not held, by recordings of people; those who do not are."""

from tests.support.repository import ROOT
from verification.measurements.honest_minutes import MOST_PERCENT, played


def test_honest_minutes_of_recorded_people_are_not_held():
    every = [played(path) for path in sorted((ROOT / "tests" / "data" / "markers").glob("*.csv"))]
    frames = sum(one.honest_frames for one in every)
    assert frames > 0
    assert 100.0 * sum(one.honest_held.total() for one in every) <= MOST_PERCENT * frames
