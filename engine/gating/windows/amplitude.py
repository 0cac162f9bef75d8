"""The amplitude window: a signal between two edges."""

import enum
from dataclasses import dataclass
from functools import cached_property

from engine.core.bounds import check_number
from engine.core.breath import WHOLE, GateSignal, SignalChoice
from engine.core.errors import InvalidValueError
from engine.core.gate_state import HoldReason
from engine.core.replacing import replace
from engine.core.sentences import say
from engine.core.signals import Ranges, check_choice
from engine.gating.windows.conditions import ConditionState, WindowInput, WindowVerdict, outside
from engine.gating.windows.patient_breath import Edges, SignalNow

MAX_MOTION_MM = 200.0
MAX_VOLUME_L = 20.0
MIN_PERCENT, MAX_PERCENT = -100.0, 300.0


class Unit(enum.StrEnum):
    """Unit of a window's edges."""

    MM = "mm"
    L = "l"
    PERCENT = "percent"


_EDGE_BOUNDS = {
    Unit.MM: (-MAX_MOTION_MM, MAX_MOTION_MM),
    Unit.L: (-MAX_VOLUME_L, MAX_VOLUME_L),
    Unit.PERCENT: (MIN_PERCENT, MAX_PERCENT),
}


@dataclass(frozen=True, kw_only=True)
class AmplitudeWindow:
    """The signal lies between two edges, which are inside.

    Attributes
    ----------
    hysteresis
        Distance inside the edges that the signal must reach to *enter*; it leaves at the edges themselves, so
        hysteresis can only shorten beam on.
    unit
        Of edges and hysteresis: ``mm``, ``l`` for the volume, or ``percent`` of the learned range.
    """

    choice: SignalChoice = WHOLE
    lower: float
    upper: float
    hysteresis: float = 0.0
    unit: Unit | str = Unit.MM

    def __post_init__(self) -> None:
        """Raise InvalidValueError for edges or a unit that make no window."""
        if self.unit not in set(Unit):
            raise InvalidValueError("unit", self.unit, f"one of {', '.join(Unit)}")
        object.__setattr__(self, "unit", Unit(self.unit))
        if self.unit is not Unit.PERCENT and (self.unit is Unit.L) != self.choice.is_volume:
            raise InvalidValueError("unit", self.unit, "l or percent for the volume, mm or percent for every other")
        check_choice(self.choice)
        low, high = _EDGE_BOUNDS[Unit(self.unit)]
        check_number(self._field("lower"), self.lower, low, high)
        check_number(self._field("upper"), self.upper, low, high)
        check_number(self._field("hysteresis"), self.hysteresis, 0.0, high)
        if not self.lower < self.upper:
            raise InvalidValueError(
                self._field("upper"), self.upper, f"more than {self._field('lower')} ({self.lower:g})"
            )
        half_width = 0.5 * (self.upper - self.lower)
        if not self.hysteresis < half_width:
            bound = f"less than half the window's width ({half_width:g})"
            raise InvalidValueError(self._field("hysteresis"), self.hysteresis, bound)

    @cached_property
    def leaves(self) -> "tuple[AmplitudeWindow, ...]":
        """The window itself."""
        return (self,)

    @cached_property
    def choices(self) -> tuple[SignalChoice, ...]:
        """The signals it uses."""
        return (self.choice,)

    @property
    def needs_ranges(self) -> bool:
        """Whether its edges are in per cent; no value is inside before they are converted to mm or l."""
        return self.unit is Unit.PERCENT

    def resolved(self, ranges: Ranges) -> "AmplitudeWindow":
        """Convert per cent to mm or l; unchanged where the range is unknown or empty."""
        learned = ranges.get(self.choice)
        if self.unit is not Unit.PERCENT or learned is None or not learned.high > learned.low:
            return self
        reach = 0.01 * (learned.high - learned.low)
        return AmplitudeWindow(
            choice=self.choice,
            lower=learned.low + self.lower * reach,
            upper=learned.low + self.upper * reach,
            hysteresis=self.hysteresis * reach,
            unit=Unit.L if self.choice.is_volume else Unit.MM,
        )

    def shifted(self, choice: SignalChoice, by: float) -> "AmplitudeWindow":
        """Move both edges by a baseline correction of that signal [mm or l]; raise InvalidValueError for per cent."""
        if choice != self.choice:
            return self
        if self.unit is Unit.PERCENT:
            raise InvalidValueError("unit", self.unit, say("mm or l: the breathing range is not known yet"))
        return replace(self, lower=self.lower + by, upper=self.upper + by)

    @cached_property
    def edges(self) -> Edges:
        """The edges and the hysteresis, in the window's unit."""
        return Edges(self.lower, self.upper, self.hysteresis)

    def signal_now(self, frame_input: WindowInput) -> SignalNow:
        """Return what the patient's breath is judged by."""
        return SignalNow(
            value=self.choice.value_in(frame_input.motion),
            at_us=frame_input.timestamp_us,
            edges=None if self.unit is Unit.PERCENT else self.edges,
            is_out=False,
            breath=frame_input.depth_of(self.choice),
            per_mm=self.choice.per_mm,
        )

    def contains(self, value: float, *, was_inside: bool) -> bool:
        """Whether the signal is inside; NaN never is."""
        margin = 0.0 if was_inside else self.hysteresis
        return self.lower + margin <= value <= self.upper - margin

    def judge(self, frame_input: WindowInput, states: tuple[ConditionState, ...]) -> WindowVerdict:
        """Evaluate one frame."""
        state = states[0]
        if self.unit is Unit.PERCENT:
            return outside(
                state,
                HoldReason.RANGE_UNKNOWN,
                say("the breathing range of {label} is not known yet", label=self.choice.label),
            )
        value = self.choice.value_in(frame_input.motion)
        if self.contains(value, was_inside=state.is_inside):
            return WindowVerdict(is_inside=True, states=(state if state.is_inside else replace(state, is_inside=True),))
        digits = 3 if self.unit is Unit.L else 2
        edges = say(
            "{lower} to {upper} {unit}",
            lower=f"{self.lower:.{digits}f}",
            upper=f"{self.upper:.{digits}f}",
            unit=self.unit,
        )
        detail = say("{value} {unit} is not inside {edges}", value=f"{value:.{digits}f}", unit=self.unit, edges=edges)
        return outside(state, HoldReason.OUTSIDE_WINDOW, detail)

    def _field(self, name: str) -> str:
        return f"{name}_{self.unit}"


def amplitude_window(
    *,
    signal: GateSignal | str = GateSignal.WHOLE,
    row: int | None = None,
    column: int | None = None,
    lower_mm: float,
    upper_mm: float,
    hysteresis_mm: float = 0.0,
) -> AmplitudeWindow:
    """Make an amplitude window of one signal between two edges in mm."""
    choice = SignalChoice(signal=signal, row=row, column=column)
    return AmplitudeWindow(choice=choice, lower=lower_mm, upper=upper_mm, hysteresis=hysteresis_mm)
