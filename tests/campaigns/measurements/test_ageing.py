"""The table of ageing pictures: what the earlier rule let pass is noticed now."""

import pytest

from tests.campaigns.measurements.ageing import CLOCK_ERRORS, EARLIER_LAG_MS, rows


@pytest.fixture(scope="module")
def table():
    return list(rows(seconds=300.0))


def test_every_clock_is_in_it_and_no_picture_is_older_than_the_lag_limit_when_it_is_noticed(table):
    assert {row.clock_error for row in table} == set(CLOCK_ERRORS)
    assert all(row.present.by is not None for row in table)
    assert max(row.present.age_ms for row in table) <= EARLIER_LAG_MS


def test_the_earlier_rule_let_pictures_age_by_seconds_behind_a_fast_clock(table):
    (row,) = (row for row in table if row.clock_error == 5e-3 and 5.4e-3 < row.growth < 5.5e-3)
    assert (row.earlier.by, row.present.by) == (None, "frame_late")
    assert row.earlier.age_ms > 1_500.0
    assert row.present.age_ms < 30.0
