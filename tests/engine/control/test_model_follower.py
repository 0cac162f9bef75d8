"""A changed model or reference is seen once; a window in per cent is resolved once for each reference, and again for
another window."""

from types import SimpleNamespace

import pytest

from engine.control.session_state import ModelFollower


class Learned:
    """A learner with a status, and the ranges that it knows."""

    def __init__(self):
        self.status = SimpleNamespace(model_generation=1, reference_number=1)
        self.known = {}

    def learned_ranges(self, _choices):
        return self.known


class Windows:
    """Limits that record the ranges with which their window is resolved."""

    def __init__(self):
        self.prescribed_window = SimpleNamespace(needs_ranges=True, choices=("whole",))
        self.resolved = []
        self.breaths = []

    def use_breaths(self, ranges):
        self.breaths.append(dict(ranges))

    def resolve_window(self, ranges):
        self.resolved.append(dict(ranges))


@pytest.fixture
def learned():
    return Learned()


@pytest.fixture
def windows():
    return Windows()


@pytest.fixture
def follower(learned, windows):
    return ModelFollower(learned, windows)


def test_a_change_is_seen_once(follower, learned):
    assert not follower.has_changed()
    learned.status.model_generation = 2
    assert follower.has_changed()
    assert not follower.has_changed()


def test_the_learned_breath_is_taken_from_the_model_in_use(follower, learned, windows):
    follower.has_changed()
    learned.known = {"whole": 1}
    follower.has_changed()
    follower.has_changed()
    learned.known, learned.status.model_generation = {"whole": 2}, 2
    follower.has_changed()
    assert windows.breaths == [{}, {"whole": 1}, {"whole": 2}]


def test_a_window_is_resolved_once_a_range_is_known_and_not_by_another_model(follower, learned, windows):
    follower.resolve_window()
    learned.known = {"whole": 1}
    follower.resolve_window()
    learned.known = {"whole": 2}
    learned.status.model_generation = 2
    follower.resolve_window()
    assert windows.resolved == [{}, {"whole": 1}]


@pytest.mark.parametrize("why", ["another reference", "another window"])
def test_it_is_resolved_again(follower, learned, windows, why):
    learned.known = {"whole": 1}
    follower.resolve_window()
    learned.known = {"whole": 2}
    if why == "another window":
        follower.resolve_again()
    else:
        learned.status.reference_number = 2
    follower.resolve_window()
    assert windows.resolved == [{"whole": 1}, {"whole": 2}]


def test_a_window_in_mm_needs_no_range(follower, windows):
    windows.prescribed_window.needs_ranges = False
    follower.resolve_window()
    assert windows.resolved == []
