"""Any window at all, over any motion: the beam is on only where a plain reading of the window says so.

The plain reading is written anew, without states or hysteresis: what it forbids no window may allow. Half of what is
drawn rests inside, so that the beam does go on and nothing holds vacuously.
"""

from dataclasses import replace

import pytest
from hypothesis import event, given, settings, strategies as st

from engine.core.breath import Breath, SignalChoice
from engine.core.commands import Arm
from engine.core.frames import Motion
from engine.core.gate_state import GateState
from engine.core.signals import LearnedRange
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, Condition, GateWindow, JoinedWindow, PhaseWindow
from tests.support.gating.streams import LIMITS, Stream, motion_of

pytestmark = pytest.mark.slow

CHOICES = [SignalChoice(signal=name) for name in ("whole", "thorax", "abdomen")]
RANGES = {choice: LearnedRange(low=-2.0, high=8.0) for choice in CHOICES}

edges = st.tuples(st.floats(-5.0, 4.0), st.floats(0.5, 8.0), st.floats(0.0, 0.2))
amplitudes = st.builds(
    lambda choice, edge: AmplitudeWindow(choice=choice, lower=edge[0], upper=edge[0] + edge[1], hysteresis=edge[2]),
    st.sampled_from(CHOICES),
    edges,
)
per_cents = st.builds(
    lambda window: AmplitudeWindow(
        choice=window.choice, lower=10.0 * window.lower, upper=10.0 * window.upper, unit="percent"
    ).resolved(RANGES),
    amplitudes,
)
holds = st.builds(
    BreathHoldWindow,
    level=amplitudes,
    settle_ms=st.floats(100.0, 200.0),
    still=st.floats(0.5, 2.0),
    max_drift=st.floats(0.5, 2.0),
    timeout_s=st.floats(1.0, 2.0),
)
phases = st.builds(
    lambda start, width: PhaseWindow(from_percent=start, to_percent=(start + width) % 100.0),
    st.floats(0.0, 99.0),
    st.floats(5.0, 80.0),
)
conditions = st.one_of(amplitudes, amplitudes, per_cents, holds, phases)
windows = st.one_of(
    conditions,
    st.builds(
        lambda joined, join: JoinedWindow(conditions=tuple(joined), join=join),
        st.lists(conditions, min_size=2, max_size=4),
        st.sampled_from(["and", "or"]),
    ),
)
levels = st.tuples(
    *(st.floats(-6.0, 9.0) for _ in CHOICES), st.floats(0.0, 99.9), st.sampled_from([None, 0.3, 0.9, 0.9])
)
chapters = st.lists(st.tuples(levels, st.integers(1, 40)), min_size=2, max_size=6)


def plainly_inside(condition: Condition, motion: Motion, breath: Breath) -> bool:
    """The window as one would say it in a sentence."""
    if isinstance(condition, PhaseWindow):
        start, end, phase = condition.from_percent, condition.to_percent, breath.phase_percent
        if phase is None or breath.phase_confidence < condition.min_confidence:
            return False
        return start <= phase <= end if start < end else phase >= start or phase <= end
    level = condition.level if isinstance(condition, BreathHoldWindow) else condition
    return level.lower <= level.choice.value_in(motion) <= level.upper


def plainly(window: GateWindow, motion: Motion, breath: Breath) -> bool:
    met = [plainly_inside(condition, motion, breath) for condition in window.leaves]
    is_or = isinstance(window, JoinedWindow) and window.join == "or"
    return any(met) if is_or else all(met)


@settings(max_examples=400, deadline=None)
@given(windows, chapters)
def test_the_beam_is_on_only_where_a_plain_reading_of_the_window_allows_it(window, chapters):
    stream = Stream(replace(LIMITS, window=window, max_jump_mm=20.0))
    stream.good(2)
    stream.step(Arm(operator="ann"))
    was_on = False
    held_for = 0
    for (whole, thorax, abdomen, phase, confidence), frames in chapters:
        motion = motion_of(whole, thorax_mm=thorax, abdomen_mm=abdomen)
        is_known = confidence is not None
        breath = Breath(phase_percent=phase if is_known else None, phase_confidence=confidence or 0.0)
        for _ in range(frames):
            state = stream.feed(replace(stream.upcoming(), motion=motion, breaths=(breath,))).state
            is_allowed = plainly(window, motion, breath)
            assert is_allowed or state is GateState.HOLD
            was_on |= state is GateState.BEAM_ON
            held_for = held_for + 1 if state is GateState.BEAM_ON else 0
            if isinstance(window, BreathHoldWindow):  # two seconds are sixty frames
                assert held_for <= 61
    event("on" if was_on else "never on")


@settings(max_examples=200, deadline=None)
@given(st.one_of(amplitudes, per_cents, phases))
def test_a_patient_who_rests_in_the_middle_of_a_window_gets_the_beam(window):
    if isinstance(window, PhaseWindow):
        middle = (window.from_percent + 0.5 * ((window.to_percent - window.from_percent) % 100.0)) % 100.0
        motion, breath = motion_of(), Breath(phase_percent=middle, phase_confidence=0.9)
    else:
        level = 0.5 * (window.lower + window.upper)
        motion, breath = motion_of(level, thorax_mm=level, abdomen_mm=level), Breath()
    stream = Stream(replace(LIMITS, window=window, max_jump_mm=20.0))
    stream.good(2)
    stream.step(Arm(operator="ann"))
    states = [stream.feed(replace(stream.upcoming(), motion=motion, breaths=(breath,))).state for _ in range(8)]
    assert states[-1] is GateState.BEAM_ON
