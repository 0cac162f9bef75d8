"""The gate's decisions on a signal."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from engine.core.bounds import check_number
from engine.core.breath import WHOLE
from engine.core.errors import InvalidValueError, ModelError
from engine.core.frames import BoolArray
from engine.gating.limits import GateLimits
from engine.gating.windows import GateWindow, breath_depths
from engine.offline.signal_gate import EXHALES, gate_frames, learn_signal
from tidegate._signals import Signal

LEARN_BOUNDS_S = (4.0, 600.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gating:
    """What the gate decided on a signal, 30 times a second from the end of the learning on.

    Attributes
    ----------
    signal
        The signal at those times [mm], from the reference.
    reference_mm
        Level of the reference, the mean of the last ends of exhale while learning, in the given signal.
    window
        The window with edges in mm.
    is_on
        Whether the beam is on, shape (n,).
    reasons
        Code of the reason of each frame without beam; None while it is on.
    """

    signal: Signal
    reference_mm: float
    window: GateWindow
    is_on: BoolArray
    reasons: tuple[str | None, ...]

    @property
    def duty_percent(self) -> float:
        """Share of the time with the beam on, 0 to 100."""
        return 100.0 * float(np.mean(self.is_on))

    @property
    def pulses_s(self) -> npt.NDArray[np.float64]:
        """Begin and end of each time with the beam on [s], shape (k, 2)."""
        steps = np.flatnonzero(np.diff(np.concatenate([[False], self.is_on, [False]]).astype(np.int8)))
        last = len(self.is_on) - 1
        return np.asarray(self.signal.time_s[np.minimum(steps, last)].reshape(-1, 2))

    @property
    def residual_mm(self) -> float:
        """Range of the motion while the beam is on, 5th to 95th percentile [mm]; NaN where it never is."""
        inside = self.signal.value_mm[self.is_on]
        return float(np.ptp(np.percentile(inside, (5.0, 95.0)))) if len(inside) else float("nan")


def gate(signal: Signal, window: GateWindow, *, limits: GateLimits | None = None, learn_s: float = 20.0) -> Gating:
    """Gate a signal as a session gates the whole region: learn its breathing, arm, decide on each frame.

    Parameters
    ----------
    window
        On the whole region; edges in mm from the reference, or in per cent of the learned range.
    limits
        Limits of the gate, of which the window is replaced; the defaults of a session without these.
    learn_s
        Length of the beginning from which breathing and reference are learned [s], 4 to 600.

    Raises
    ------
    ModelError
        The signal has too few breaths while learning, or nothing after.
    InvalidValueError
        The signal is not measured throughout, ``learn_s`` is out of its bounds, or the window is on another region.
    """
    check_number("learn_s", learn_s, *LEARN_BOUNDS_S)
    if not np.all(np.isfinite(signal.value_mm)):
        raise InvalidValueError("signal", "not measured throughout", "finite")
    if any(choice != WHOLE for choice in window.choices):
        raise InvalidValueError("window", "on another signal", "on the whole region")
    learned = learn_signal(signal.time_s, signal.value_mm, learn_s)
    if learned is None:
        msg = f"{signal.name}: fewer than {EXHALES} breaths in the first {learn_s:g} s, or nothing after"
        raise ModelError(msg)
    ranges = {WHOLE: learned.learned}
    resolved = window.resolved(ranges)
    given = limits or GateLimits(window=resolved)
    limits = replace(
        given, window=resolved, operator_timeout_s=0.0, is_played=True, breath_depths=breath_depths(ranges)
    )
    is_on, reasons = gate_frames(limits, list(learned.frames()))
    return Gating(
        signal=Signal(
            name=signal.name,
            time_s=np.asarray(learned.time_s, dtype=np.float64),
            value_mm=np.asarray(learned.value_mm, dtype=np.float64),
        ),
        reference_mm=learned.reference,
        window=resolved,
        is_on=is_on,
        reasons=tuple(None if reason is None else reason.value for reason in reasons),
    )
