"""What `tests/engine/core/test_guard_pages.py` runs in a process of its own, with every array at the end of a page."""

from tests.support.evaluation.confirmed_references import confirmed_references


def test_sessions(calm_volunteer):
    assert len(confirmed_references(calm_volunteer, starts=4)) == 4
