"""Runs a breathing monitor on each configured signal, on measured frames only.

Owned by the pipeline's thread. Lost frames are left out, and of each signal those that show less than half of it, since
the model extrapolates there; after more than half a second without a measured frame the phase has to be found again.
Changes of the measurement must not count as breathing: if an operator sets a new reference, the monitors' levels shift
with it, and drift is measured from the patient's position then; if a new model takes over with a transferred reference,
the signals continue; in all other cases the monitors restart.
"""

import math

from engine.core.breath import Breath, SignalChoice
from engine.core.errors import InvalidValueError
from engine.core.frames import Motion
from engine.core.signals import seen_share_of, signal_of
from engine.motion.breathing import (
    BreathingState,
    correct_baseline,
    follow_breathing,
    shifted,
    start_breathing,
    with_baseline,
)
from engine.motion.learning.prepared_model import PreparedModel

US_PER_S = 1e6
MAX_SIGNALS = 4
MIN_SEEN_SHARE = 0.5


def check_signals(signals: tuple[SignalChoice, ...]) -> None:
    """Raise InvalidValueError for more than `MAX_SIGNALS` signals or a repeated one."""
    if len(signals) > MAX_SIGNALS:
        raise InvalidValueError("breath_signals", len(signals), f"at most {MAX_SIGNALS} signals")
    if len(set(signals)) < len(signals):
        raise InvalidValueError("breath_signals", [signal.label for signal in signals], "each signal once")


class BreathTracker:
    """One breathing monitor per signal."""

    def __init__(self, signals: tuple[SignalChoice, ...]) -> None:
        self._states = tuple(start_breathing(signal) for signal in signals)
        self._active: PreparedModel | None = None

    def has_reference_changed(self, active: PreparedModel, *, is_reference_new: bool) -> bool:
        """Update the model in use; return whether the reference changed while the model did not.

        The caller then calls `move` before the frame is added.
        """
        is_same_model = active is self._active
        self._active = active
        if is_reference_new and not is_same_model:
            self._states = tuple(start_breathing(state.choice) for state in self._states)
        return is_reference_new and is_same_model

    def move(self, before: Motion, now: Motion, *, is_end_exhale: bool) -> None:
        """Shift the monitors by the change of one frame's motion from the old to the new reference.

        Drift then counts from the last end of exhale; of the first signal from the reference itself where that is the
        mean of its last ends of exhale: the last one alone may have been a hitch.
        """
        moved = [
            shifted(state, signal_of(state.choice, now) - signal_of(state.choice, before)) for state in self._states
        ]
        self._states = tuple(
            with_baseline(state, 0.0) if is_end_exhale and state is moved[0] else _with_current_baseline(state)
            for state in moved
        )

    def correct(self, choice: SignalChoice, by: float) -> None:
        """Apply an operator's confirmed change of a signal's baseline [mm; l for the volume]."""
        self._states = tuple(correct_baseline(state, by) if state.choice == choice else state for state in self._states)

    def follow(self, motion: Motion, timestamp_us: int) -> tuple[Breath, ...]:
        """Add a measured frame; return the breathing figures of each signal."""
        seconds = timestamp_us / US_PER_S
        self._states = tuple(follow_breathing(state, seconds, _seen_mm(state.choice, motion)) for state in self._states)
        return tuple(state.breath for state in self._states)


def _seen_mm(choice: SignalChoice, motion: Motion) -> float:
    """Return a signal [mm; l for the volume]; NaN where the frame shows too little of it."""
    return signal_of(choice, motion) if seen_share_of(choice, motion.seen) >= MIN_SEEN_SHARE else math.nan


def _with_current_baseline(state: BreathingState) -> BreathingState:
    """Measure drift from the present end of exhale; restart the monitor if that is unknown."""
    level = state.breath.baseline
    return start_breathing(state.choice) if level is None else with_baseline(state, level)
