"""The limits of a running session: the site's limits with the window that is in use.

Owned by the engine thread, and changed only between two decisions: a window in per cent is resolved into mm once the
learned range is known, and a person may correct the baseline.
"""

import math
from dataclasses import replace

from engine.core.frames import Measurement
from engine.core.signals import Ranges, signal_of
from engine.gating.active_window import ActiveWindow, SetWindow, WindowChange, checked_change, refuse_wide
from engine.gating.frame_checks import unseen_signal
from engine.gating.limits import GateLimits
from engine.gating.windows import GateWindow, breath_depths


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
        return motion is not None and all(math.isfinite(signal_of(choice, motion)) for choice in choices)

    def unseen_signal(self, measurement: Measurement) -> str | None:
        """Return which signal of the window the frame shows too little of; None if none, or nothing was measured."""
        return None if measurement.motion is None else unseen_signal(measurement.motion.seen, self.current)

    def signal_mm(self, measurement: Measurement) -> float | None:
        """Return the first gated signal [mm]; None where it was not measured, or is the volume."""
        choice = self.current.window.choices[0]
        if measurement.motion is None or choice.is_volume:
            return None
        signal_mm = signal_of(choice, measurement.motion)
        return signal_mm if math.isfinite(signal_mm) else None
