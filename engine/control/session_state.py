"""The state of a running session: the limits with the window in use, and the two roles that the engine needs filled.

Owned by the engine thread, and changed only between two decisions: a window in per cent is resolved into mm once the
learned range is known, and a person may correct the baseline. :class:`engine.motion.pipeline.Pipeline` and its learner
fill the roles; tests fill them with scripted ones.
"""

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Protocol

from engine.core.breath import SignalChoice
from engine.core.frames import Measurement, RgbdFrame
from engine.core.learning_status import LearningEvent, LearningStatus
from engine.core.motion_model import MotionModel
from engine.core.reference import ReferenceDistance, ReferenceMoment
from engine.core.signals import LearnedLevels, Ranges
from engine.gating.active_window import ActiveWindow, SetWindow, WindowChange, checked_change, refuse_wide
from engine.gating.frame_checks import unseen_signal
from engine.gating.limits import GateLimits
from engine.gating.windows import GateWindow, breath_depths


class Measurer(Protocol):
    """Measures frames."""

    def measure(self, frame: RgbdFrame) -> Measurement:
        """Measure one frame; a frame that cannot be measured is a value (lost), an exception is a bug."""

    def learn(self) -> None:
        """Do what the decision on the last frame did not wait for."""

    def correct_baseline(self, choice: SignalChoice, by: float) -> None:
        """Count the drift of a signal from a level that is ``by`` higher than the learned one [mm or l]."""

    def camera_warmed(self) -> None:
        """Drop the reference, which was set while the camera's readings drifted. A person has to set it again."""

    def camera_returned(self) -> None:
        """Drop what was known of the patient's position: the camera was away. A person has to set the reference."""


class Learner(Protocol):
    """Learns motion models and owns the reference."""

    @property
    def status(self) -> LearningStatus:
        """The model and the reference in use."""

    def learned_ranges(self, choices: Iterable[SignalChoice]) -> Ranges:
        """Return each signal's range in the training, against the present reference; empty where there is none."""

    def reference_distance(self, moment: ReferenceMoment) -> ReferenceDistance | None:
        """Return how far the position that would become the reference lies from the fraction's first; None without one.

        Raises
        ------
        CommandRefusedError
            No such position is known.
        """

    def learned_levels(self, choices: Iterable[SignalChoice]) -> LearnedLevels:
        """Return each signal's levels in the training, against the present reference; empty where there is none."""

    def set_reference(self, moment: ReferenceMoment = ReferenceMoment.NOW, *, most_mm: float | None = None) -> None:
        """Make the proposed position, or that of the next measured frame, the reference.

        It is dropped when it is taken up where it lies further than ``most_mm`` from the fraction's first reference, or
        at an unknown distance; None accepts any.

        Raises
        ------
        TidegateError
            There is no model, or no such position is known.
        """

    def keep_model(self, *, is_kept: bool) -> None:
        """Set, before each frame, whether the present model must stay: an armed gate decides by it."""

    def retrain(self, *, keeps_reference: bool = True) -> None:
        """Gather frames and learn again; ``keeps_reference`` transfers the reference to the new model."""

    def activate(self, model: MotionModel) -> None:
        """Measure with ``model`` once the reference is transferred to it; raise ModelError if it does not fit."""

    def apply_model(self) -> None:
        """Switch to the model that waits; raise CommandRefusedError if none does."""

    def take_notices(self) -> list[LearningEvent]:
        """Return the learning events since the last call."""


class SessionLimits:
    """Holds the limits in use.

    Attributes
    ----------
    current
        What the gate decides by now; a frozen value, replaced when the window changes.
    """

    def __init__(self, limits: GateLimits) -> None:
        self.current = limits
        self._window = ActiveWindow(requested=limits.window, converted=limits.window)

    def set_played(self, *, is_played: bool) -> None:
        """Set whether frames come from a recording: that decides what the lag of a frame means."""
        self.current = replace(self.current, is_played=is_played)

    def resolve_window(self, ranges: Ranges) -> None:
        """Resolve a window in per cent into mm and l, from the learned ranges against the present reference."""
        self.use(self._window.with_ranges(ranges))

    def use_breaths(self, ranges: Ranges) -> None:
        """Tell a breath by the learned ranges of the model in use."""
        self.current = replace(self.current, breath_depths=breath_depths(ranges))

    def corrected(self, by: float) -> ActiveWindow:
        """Return the window moved by ``by`` [mm, l of the volume]; raise InvalidValueError beyond the site's limits."""
        corrected = self._window.corrected(by, self.current)
        refuse_wide(corrected.window, self.current)
        return corrected

    def clear_correction(self) -> None:
        """Return to the window without its correction: motion is counted from a new reference."""
        self.use(self._window.without_correction())

    def use(self, window: ActiveWindow) -> None:
        """Decide by ``window`` from now on."""
        self._window = window
        self.current = replace(self.current, window=window.window)

    def changed(self, command: SetWindow, ranges: Ranges) -> WindowChange:
        """Return the window and limits after ``command``, in use only with `use_change`; raise InvalidValueError."""
        return checked_change(self._window.requested, command, self.current, ranges)

    def use_change(self, change: WindowChange) -> None:
        """Decide by another window and its times from now on."""
        self._window, self.current = change.window, change.limits

    @property
    def prescribed_window(self) -> GateWindow:
        """The window that was prescribed: still in per cent where it was prescribed so, and not corrected."""
        return self._window.requested

    @property
    def correction(self) -> float:
        """Sum of all corrections [mm, l of the volume]."""
        return self._window.correction

    @property
    def is_window_unresolved(self) -> bool:
        """Whether a part of the window is still in per cent."""
        return self.current.window.needs_ranges

    def refuse_wide_window(self) -> None:
        """Raise InvalidValueError where the window, as resolved and corrected, exceeds the site's limits."""
        refuse_wide(self.current.window, self.current)

    def is_signal_measured(self, measurement: Measurement) -> bool:
        """Whether every signal of the window was measured."""
        motion = measurement.motion
        choices = self.current.window.choices
        return motion is not None and all(math.isfinite(choice.value_in(motion)) for choice in choices)

    def unseen_signal(self, measurement: Measurement) -> str | None:
        """Return which signal of the window the frame shows too little of; None if none, or nothing was measured."""
        return None if measurement.motion is None else unseen_signal(measurement.motion.seen, self.current)

    def signal_mm(self, measurement: Measurement) -> float | None:
        """Return the first gated signal [mm]; None where it was not measured, or is the volume."""
        choice = self.current.window.choices[0]
        if measurement.motion is None or choice.is_volume:
            return None
        signal_mm = choice.value_in(measurement.motion)
        return signal_mm if math.isfinite(signal_mm) else None


class ModelFollower:
    """Remembers with which model the gate was armed, and for which reference the window was resolved."""

    def __init__(self, learner: Learner, limits: SessionLimits) -> None:
        self._learner, self._limits = learner, limits
        self._generation = learner.status.model_generation
        self._resolved_for: int | None = None
        self._is_depth_known = False

    def has_changed(self) -> bool:
        """Whether the model or the reference has changed since the last call."""
        before, self._generation = self._generation, self._learner.status.model_generation
        if before == self._generation and self._is_depth_known:
            return False
        ranges = self._learner.learned_ranges(self._limits.prescribed_window.choices)
        self._limits.use_breaths(ranges)
        self._is_depth_known = bool(ranges)
        return before != self._generation

    def resolve_window(self) -> None:
        """Resolve a window in per cent into mm, once for each reference that is set.

        Another model with the same reference has another learned range, of where the patient lies now: a window that
        took it over would follow a drift that no person has confirmed.
        """
        reference = self._learner.status.reference_number
        if self._resolved_for == reference or not self._limits.prescribed_window.needs_ranges:
            return
        ranges = self._learner.learned_ranges(self._limits.prescribed_window.choices)
        self._limits.resolve_window(ranges)
        if ranges:
            self._resolved_for = reference

    def resolve_again(self) -> None:
        """Resolve another window with the next frame: by then a range may be known."""
        self._resolved_for = None
