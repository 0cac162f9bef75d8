"""What is remembered of a signal from frame to frame; whole histories are in test_beam_on_limit.py."""

import pytest

from engine.gating.windows.patient_breath import AWAY_S, OUT_S, Edges, SignalNow, SignalTrail

FRAME_US = 33_333
GAP_MS = 100.0
EDGES = Edges(lower=0.0, upper=3.0, hysteresis=0.2)


def after(trail, value, us):
    now = SignalNow(value=value, at_us=trail.at_us + us, edges=EDGES, is_out=False, breath=None, per_mm=1.0)
    return trail.followed(now, GAP_MS)


def beyond(seconds, *, gap_us=FRAME_US):
    """Return the trail of a signal beyond its edge for so long, with a gap before the last two frames."""
    trail = SignalTrail(place=1.0, edges=EDGES, moved_on_ns=1)
    frames = round(seconds * 1e6 / FRAME_US)
    for number in range(frames):
        trail = after(trail, 9.0, gap_us if number == frames - 2 else FRAME_US)
    return trail


def test_a_signal_beyond_its_edge_for_long_enough_is_a_breath_and_a_gap_begins_it_anew():
    long_s = 1.5 * max(AWAY_S, OUT_S)
    assert beyond(long_s).breathed_from_ns(5) == 5
    broken = beyond(long_s, gap_us=round(GAP_MS * 1000) + 1)
    assert broken.breathed_from_ns(5) is None


@pytest.mark.parametrize(("gap_us", "is_known"), [(100_000, True), (100_001, False), (-1, False)])
def test_values_on_both_sides_of_a_gap_are_no_noise(gap_us, is_known):
    trail = after(after(after(SignalTrail(), 1.0, FRAME_US), 1.0, FRAME_US), 5.0, gap_us)
    assert (trail.noise > 0.0, len(trail.recent)) == (is_known, 2 if is_known else 1)
