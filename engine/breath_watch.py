"""Follows the breath of the signals that are watched, measured frame by measured frame.

Owned by the pipeline's thread. Frames that were not measured are not fed: after more than half a second of them the
phase is found anew. What the measuring does to the signals is no breath: where a person sets another zero, all that
is remembered moves with it, and drift counts from where the patient lies then; where a model takes over behind a zero
that is carried over, the signals go on; in every other case they begin anew.
"""

from engine.active_model import ActiveModel
from engine.breath import Breath, SignalChoice
from engine.errors import InvalidValueError
from engine.frames import Motion
from engine.stages.breathing import (
    BreathingState,
    correct_baseline,
    follow_breathing,
    shifted,
    start_breathing,
    with_baseline,
)
from engine.windows import signal_of

US_PER_S = 1e6
MAX_SIGNALS = 4


def check_signals(signals: tuple[SignalChoice, ...]) -> None:
    """Refuse more signals than a frame has time for, and one told twice."""
    if len(signals) > MAX_SIGNALS:
        raise InvalidValueError("breath_signals", len(signals), f"at most {MAX_SIGNALS} signals")
    if len(set(signals)) < len(signals):
        raise InvalidValueError("breath_signals", [signal.label for signal in signals], "each signal once")


class BreathWatch:
    """One monitor a signal."""

    def __init__(self, signals: tuple[SignalChoice, ...]) -> None:
        self._states = tuple(start_breathing(signal) for signal in signals)
        self._active: ActiveModel | None = None

    def is_zero_moved(self, active: ActiveModel, *, is_zero_new: bool) -> bool:
        """Say with what a frame is measured; return whether the same surface has another motion now.

        Then :meth:`move` is due, before the frame is fed.
        """
        is_same_model = active is self._active
        self._active = active
        if is_zero_new and not is_same_model:
            self._states = tuple(start_breathing(state.choice) for state in self._states)
        return is_zero_new and is_same_model

    def move(self, before: Motion, now: Motion) -> None:
        """Take one frame measured from the zero before and from that of now."""
        self._states = tuple(
            _settled(shifted(state, signal_of(state.choice, now) - signal_of(state.choice, before)))
            for state in self._states
        )

    def correct(self, choice: SignalChoice, by: float) -> None:
        """Tell drift against a level so much higher than the learned one: a person has seen and confirmed it."""
        self._states = tuple(correct_baseline(state, by) if state.choice == choice else state for state in self._states)

    def follow(self, motion: Motion, timestamp_us: int) -> tuple[Breath, ...]:
        """Take a measured frame; return where each signal stands in its breath."""
        seconds = timestamp_us / US_PER_S
        self._states = tuple(
            follow_breathing(state, seconds, signal_of(state.choice, motion)) for state in self._states
        )
        return tuple(state.breath for state in self._states)


def _settled(state: BreathingState) -> BreathingState:
    """Count drift from the present end of exhale on; where it is not known, no breath of before tells of it."""
    level = state.breath.baseline
    return start_breathing(state.choice) if level is None else with_baseline(state, level)
