"""Gating windows: when the patient is where the beam may be. Amplitude, breath hold, phase; alone, or joined.

A window judges one trusted frame after the other and is pure: what it must remember is a value the gate keeps. Lengths
are motion against the reference [mm], positive towards the camera; volumes are litres; per cent are of the range the
patient breathed over while the model was learned, 0 at the end of exhale. Per cent are turned into mm or l once, when
the model or the reference changes: a window never follows the patient.

Nothing here can keep a beam on: a frame outside is outside at once.
"""

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

from engine.breath import WHOLE, Breath, GateSignal, SignalChoice
from engine.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from engine.errors import InvalidValueError
from engine.frames import ROI_COLUMNS, ROI_ROWS, Motion
from engine.permits import HoldReason

MAX_MOTION_MM = 200.0
MAX_VOLUME_L = 20.0
MIN_PERCENT, MAX_PERCENT = -100.0, 300.0
MAX_CONDITIONS = 4
HOLD_BOUNDS: dict[str, tuple[float, float]] = {
    "settle_ms": (100.0, 10_000.0),
    "still": (0.05, 20.0),
    "max_drift": (0.1, 20.0),
    "timeout_s": (1.0, 120.0),
}
"""Lowest and highest value of what describes a breath hold; ``still`` and ``max_drift`` are mm, or l of a volume."""


class Unit(enum.StrEnum):
    """What a window's edges are told in."""

    MM = "mm"
    L = "l"
    PERCENT = "percent"


_EDGE_BOUNDS = {
    Unit.MM: (-MAX_MOTION_MM, MAX_MOTION_MM),
    Unit.L: (-MAX_VOLUME_L, MAX_VOLUME_L),
    Unit.PERCENT: (MIN_PERCENT, MAX_PERCENT),
}


class Join(enum.StrEnum):
    """How conditions are joined."""

    AND = "and"
    OR = "or"


class HoldKind(enum.StrEnum):
    """Which end of the breath is held."""

    INSPIRATION = "inspiration"
    EXPIRATION = "expiration"


class HoldStage(enum.StrEnum):
    """Where a breath hold stands."""

    AWAITED = "awaited"
    SETTLING = "settling"
    HELD = "held"
    DRIFTED = "drifted"
    OVER = "over"


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnedRange:
    """The range a signal had while the model was learned, against the present reference [mm or l]."""

    low: float
    high: float


Ranges = Mapping[SignalChoice, LearnedRange]


class Sight(NamedTuple):
    """What a window is shown of one trusted frame."""

    motion: Motion
    breaths: tuple[Breath, ...]
    timestamp_us: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ConditionState:
    """What one condition remembers from frame to frame.

    Attributes
    ----------
    is_inside
        Whether the last trusted frame was inside.
    stage, since_us
        Of a breath hold: where it stands, and since when by the device's clock.
    lowest, highest
        Of a breath hold: extremes of the signal while it settles.
    settled_at, held_since_us
        Of a breath hold: the level at which it was found still, and when; kept over frames that could not be judged,
        for the patient has not breathed meanwhile. None before it was.
    holds
        Breath holds counted so far: those that came to be still.
    """

    is_inside: bool = False
    stage: HoldStage = HoldStage.AWAITED
    since_us: int = 0
    lowest: float = math.inf
    highest: float = -math.inf
    settled_at: float | None = None
    held_since_us: int = 0
    holds: int = 0


class WindowVerdict(NamedTuple):
    """Whether the frame is inside, and if not why; with what to remember."""

    is_inside: bool
    states: tuple[ConditionState, ...]
    reason: HoldReason | None = None
    detail: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class AmplitudeWindow:
    """The signal lies between two edges, which belong to the window.

    Attributes
    ----------
    hysteresis
        How far inside the edges the signal must be to *enter*; it leaves at the edges themselves, so hysteresis can
        only take beam-on time away.
    unit
        Of edges and hysteresis: ``mm``, ``l`` for the volume, or ``percent`` of the learned range.
    """

    choice: SignalChoice = WHOLE
    lower: float
    upper: float
    hysteresis: float = 0.0
    unit: Unit | str = Unit.MM

    def __post_init__(self) -> None:
        """Refuse a window that is none."""
        if self.unit not in set(Unit):
            raise InvalidValueError("unit", self.unit, f"one of {', '.join(Unit)}")
        object.__setattr__(self, "unit", Unit(self.unit))
        if self.unit is not Unit.PERCENT and (self.unit is Unit.L) != self.choice.is_volume:
            raise InvalidValueError("unit", self.unit, "l or percent for the volume, mm or percent for every other")
        _check_choice(self.choice)
        low, high = _EDGE_BOUNDS[Unit(self.unit)]
        _check_number(self._field("lower"), self.lower, low, high)
        _check_number(self._field("upper"), self.upper, low, high)
        _check_number(self._field("hysteresis"), self.hysteresis, 0.0, high)
        if not self.lower < self.upper:
            raise InvalidValueError(
                self._field("upper"), self.upper, f"more than {self._field('lower')} ({self.lower:g})"
            )
        half_width = 0.5 * (self.upper - self.lower)
        if not self.hysteresis < half_width:
            bound = f"less than half the window's width ({half_width:g})"
            raise InvalidValueError(self._field("hysteresis"), self.hysteresis, bound)

    @property
    def leaves(self) -> "tuple[Condition, ...]":
        """Itself."""
        return (self,)

    @property
    def choices(self) -> tuple[SignalChoice, ...]:
        """The signals it looks at."""
        return (self.choice,)

    @property
    def needs_ranges(self) -> bool:
        """Whether its edges are per cent, and have to be turned into mm or l before anything can be inside."""
        return self.unit is Unit.PERCENT

    def resolved(self, ranges: Ranges) -> "AmplitudeWindow":
        """Turn per cent into mm or l; unchanged where the range is not known, or is none."""
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
        """Move both edges by a baseline correction of that signal; per cent have to be resolved before."""
        if choice != self.choice:
            return self
        if self.unit is Unit.PERCENT:
            raise InvalidValueError("unit", self.unit, "mm or l: the learned range is not known yet")
        return replace(self, lower=self.lower + by, upper=self.upper + by)

    def contains(self, value: float, *, was_inside: bool) -> bool:
        """Whether the signal is inside; NaN never is."""
        margin = 0.0 if was_inside else self.hysteresis
        return self.lower + margin <= value <= self.upper - margin

    def judge(self, sight: Sight, states: tuple[ConditionState, ...]) -> WindowVerdict:
        """Judge one frame."""
        state = states[0]
        if self.unit is Unit.PERCENT:
            return _outside(state, HoldReason.RANGE_UNKNOWN, f"the range of {self.choice.label} is not known yet")
        value = signal_of(self.choice, sight.motion)
        if self.contains(value, was_inside=state.is_inside):
            return WindowVerdict(is_inside=True, states=(replace(state, is_inside=True),))
        detail = f"{value:.2f} {self.unit} is not inside {self.lower:g} to {self.upper:g} {self.unit}"
        return _outside(state, HoldReason.OUTSIDE_WINDOW, detail)

    def _field(self, name: str) -> str:
        return f"{name}_{self.unit}"


@dataclass(frozen=True, slots=True, kw_only=True)
class BreathHoldWindow:
    """A breath that is held: reached, still, not drifting, and not for too long.

    Attributes
    ----------
    level
        Where the held breath must lie.
    kind
        Inspiration or expiration: what a person is told, and nothing else.
    settle_ms
        How long the signal must have been inside and still before the hold counts [ms of the device's clock].
    still
        Largest movement while it settles [mm or l].
    max_drift
        Largest distance from where it settled; beyond it the hold has ended, and the next begins outside the level.
    timeout_s
        Longest hold; then the patient breathes, and the next begins outside the level.
    """

    level: AmplitudeWindow
    kind: HoldKind | str = HoldKind.INSPIRATION
    settle_ms: float = 1_000.0
    still: float = 1.0
    max_drift: float = 2.0
    timeout_s: float = 25.0

    def __post_init__(self) -> None:
        """Refuse numbers out of their bounds."""
        if self.kind not in set(HoldKind):
            raise InvalidValueError("kind", self.kind, f"one of {', '.join(HoldKind)}")
        object.__setattr__(self, "kind", HoldKind(self.kind))
        for name, (low, high) in HOLD_BOUNDS.items():
            _check_number(name, getattr(self, name), low, high)

    @property
    def leaves(self) -> "tuple[Condition, ...]":
        """Itself."""
        return (self,)

    @property
    def choices(self) -> tuple[SignalChoice, ...]:
        """The signals it looks at."""
        return self.level.choices

    @property
    def needs_ranges(self) -> bool:
        """Whether its level is told in per cent."""
        return self.level.needs_ranges

    def resolved(self, ranges: Ranges) -> "BreathHoldWindow":
        """Turn per cent into mm or l."""
        return replace(self, level=self.level.resolved(ranges))

    def shifted(self, choice: SignalChoice, by: float) -> "BreathHoldWindow":
        """Move the level by a baseline correction."""
        return replace(self, level=self.level.shifted(choice, by))

    def judge(self, sight: Sight, states: tuple[ConditionState, ...]) -> WindowVerdict:
        """Judge one frame; see :class:`HoldStage` for where the hold stands."""
        state = states[0]
        inside = self.level.judge(sight, (replace(state, is_inside=state.stage is not HoldStage.AWAITED),))
        if not inside.is_inside:
            return _outside(
                ConditionState(holds=state.holds),
                HoldReason.BREATH_HOLD_AWAITED if inside.reason is HoldReason.OUTSIDE_WINDOW else inside.reason,
                inside.detail,
            )
        if state.stage in _OVER:
            return _outside(state, _OVER[state.stage], self._needs_a_breath())
        value = signal_of(self.level.choice, sight.motion)
        ended = self._end(state, value, sight.timestamp_us)
        if ended is not None:
            return ended
        match state.stage:
            case HoldStage.HELD:
                return WindowVerdict(is_inside=True, states=(replace(state, is_inside=True),))
            case HoldStage.AWAITED:
                state = _begun(state, value, sight.timestamp_us)
        return self._settle(state, value, sight.timestamp_us)

    def _settle(self, state: ConditionState, value: float, now_us: int) -> WindowVerdict:
        lowest, highest = min(state.lowest, value), max(state.highest, value)
        if highest - lowest > self.still:
            return self._still_settling(_begun(state, value, now_us), "it moves")
        state = replace(state, lowest=lowest, highest=highest)
        if (now_us - state.since_us) * NS_PER_US < self.settle_ms * NS_PER_MS:
            return self._still_settling(state, f"still for {(now_us - state.since_us) / 1e6:.1f} s")
        held = replace(state, stage=HoldStage.HELD, since_us=now_us, is_inside=True)
        if held.settled_at is None:
            held = replace(held, settled_at=value, held_since_us=now_us, holds=state.holds + 1)
        return WindowVerdict(is_inside=True, states=(held,))

    def _still_settling(self, state: ConditionState, detail: str) -> WindowVerdict:
        return _outside(state, HoldReason.BREATH_HOLD_SETTLING, f"{detail}; {self.settle_ms / 1000.0:g} s needed")

    def _end(self, state: ConditionState, value: float, now_us: int) -> WindowVerdict | None:
        """End a hold that was found still once, on drift or by time; None while it may go on, or has not begun."""
        if state.settled_at is None:
            return None
        if not abs(value - state.settled_at) <= self.max_drift:
            ended = replace(state, stage=HoldStage.DRIFTED, since_us=now_us)
            detail = f"{abs(value - state.settled_at):.1f} {self.level.unit} from where it settled"
            return _outside(ended, HoldReason.BREATH_HOLD_DRIFTED, f"{detail}, {self.max_drift:g} allowed")
        if (now_us - state.held_since_us) * NS_PER_US >= self.timeout_s * NS_PER_S:
            ended = replace(state, stage=HoldStage.OVER, since_us=now_us)
            return _outside(ended, HoldReason.BREATH_HOLD_OVER, f"held for {self.timeout_s:g} s")
        return None

    def _needs_a_breath(self) -> str:
        return f"the patient breathes before the next {self.kind} is held"


@dataclass(frozen=True, slots=True, kw_only=True)
class PhaseWindow:
    """The breath is between two phases, 0 % at the end of inhale; over 0 where ``from_percent`` is the larger."""

    choice: SignalChoice = WHOLE
    from_percent: float
    to_percent: float
    min_confidence: float = 0.6

    def __post_init__(self) -> None:
        """Refuse a window that is none."""
        _check_choice(self.choice)
        _check_number("from_percent", self.from_percent, 0.0, 100.0)
        _check_number("to_percent", self.to_percent, 0.0, 100.0)
        _check_number("min_confidence", self.min_confidence, 0.1, 1.0)
        if self.from_percent == self.to_percent or {self.from_percent, self.to_percent} == {0.0, 100.0}:
            raise InvalidValueError(
                "to_percent", self.to_percent, f"another phase than from_percent ({self.from_percent:g})"
            )

    @property
    def leaves(self) -> "tuple[Condition, ...]":
        """Itself."""
        return (self,)

    @property
    def choices(self) -> tuple[SignalChoice, ...]:
        """The signals it looks at."""
        return (self.choice,)

    @property
    def needs_ranges(self) -> bool:
        """Phases need no range."""
        return False

    def resolved(self, ranges: Ranges) -> "PhaseWindow":  # noqa: ARG002 - every window can be asked
        """Return itself: phases need no range."""
        return self

    def shifted(self, choice: SignalChoice, by: float) -> "PhaseWindow":  # noqa: ARG002 - every window can be asked
        """Return itself: a baseline does not move phases."""
        return self

    def contains(self, phase_percent: float) -> bool:
        """Whether a phase is inside; NaN never is."""
        if self.from_percent < self.to_percent:
            return self.from_percent <= phase_percent <= self.to_percent
        return phase_percent >= self.from_percent or phase_percent <= self.to_percent

    def judge(self, sight: Sight, states: tuple[ConditionState, ...]) -> WindowVerdict:
        """Judge one frame; a phase that is not known, or not well, is outside."""
        state = states[0]
        breath = next((breath for breath in sight.breaths if breath.signal == self.choice), None)
        if breath is None or breath.phase_percent is None:
            note = "no phase is worked out" if breath is None else breath.note
            return _outside(state, HoldReason.PHASE_UNKNOWN, note)
        if not breath.phase_confidence >= self.min_confidence:
            detail = f"confidence {breath.phase_confidence:.2f}, {self.min_confidence:.2f} needed"
            return _outside(state, HoldReason.PHASE_UNKNOWN, detail)
        if not self.contains(breath.phase_percent):
            detail = f"{breath.phase_percent:.0f} % is not inside {self.from_percent:g} to {self.to_percent:g} %"
            return _outside(state, HoldReason.OUTSIDE_WINDOW, detail)
        return WindowVerdict(is_inside=True, states=(replace(state, is_inside=True),))


Condition = AmplitudeWindow | BreathHoldWindow | PhaseWindow


@dataclass(frozen=True, slots=True, kw_only=True)
class JoinedWindow:
    """Two to four conditions: inside when all are, or when any is."""

    conditions: tuple[Condition, ...]
    join: Join | str = Join.AND

    def __post_init__(self) -> None:
        """Refuse what joins nothing."""
        if self.join not in set(Join):
            raise InvalidValueError("join", self.join, f"one of {', '.join(Join)}")
        object.__setattr__(self, "join", Join(self.join))
        if not 2 <= len(self.conditions) <= MAX_CONDITIONS:
            raise InvalidValueError("conditions", len(self.conditions), f"2 to {MAX_CONDITIONS} conditions")

    @property
    def leaves(self) -> tuple[Condition, ...]:
        """The conditions."""
        return self.conditions

    @property
    def choices(self) -> tuple[SignalChoice, ...]:
        """The signals it looks at, each once, in order."""
        return tuple(dict.fromkeys(choice for condition in self.conditions for choice in condition.choices))

    @property
    def needs_ranges(self) -> bool:
        """Whether any condition is told in per cent."""
        return any(condition.needs_ranges for condition in self.conditions)

    def resolved(self, ranges: Ranges) -> "JoinedWindow":
        """Turn per cent into mm or l."""
        return replace(self, conditions=tuple(condition.resolved(ranges) for condition in self.conditions))

    def shifted(self, choice: SignalChoice, by: float) -> "JoinedWindow":
        """Move what looks at that signal by a baseline correction."""
        return replace(self, conditions=tuple(condition.shifted(choice, by) for condition in self.conditions))

    def judge(self, sight: Sight, states: tuple[ConditionState, ...]) -> WindowVerdict:
        """Judge one frame; the reason is that of the first condition that is not met."""
        verdicts = [condition.judge(sight, (state,)) for condition, state in zip(self.conditions, states, strict=True)]
        kept = tuple(verdict.states[0] for verdict in verdicts)
        unmet = next((verdict for verdict in verdicts if not verdict.is_inside), None)
        met = any(verdict.is_inside for verdict in verdicts)
        if unmet is None or (self.join is Join.OR and met):
            return WindowVerdict(is_inside=True, states=kept)
        return WindowVerdict(is_inside=False, states=kept, reason=unmet.reason, detail=unmet.detail)


GateWindow = AmplitudeWindow | BreathHoldWindow | PhaseWindow | JoinedWindow


def amplitude_window(
    *,
    signal: GateSignal | str = GateSignal.WHOLE,
    row: int | None = None,
    column: int | None = None,
    lower_mm: float,
    upper_mm: float,
    hysteresis_mm: float = 0.0,
) -> AmplitudeWindow:
    """Make the commonest window: one signal between two edges in mm."""
    choice = SignalChoice(signal=signal, row=row, column=column)
    return AmplitudeWindow(choice=choice, lower=lower_mm, upper=upper_mm, hysteresis=hysteresis_mm)


def at_rest(window: GateWindow) -> tuple[ConditionState, ...]:
    """Return what a window remembers before its first frame."""
    return tuple(ConditionState() for _ in window.leaves)


def interrupted(states: tuple[ConditionState, ...]) -> tuple[ConditionState, ...]:
    """Return what is remembered after a frame that could not be judged: what has to be inside enters anew.

    Of a breath hold it is kept how many there were, that one has ended and a breath is due, and, of one that was found
    still, where and since when: whoever is not seen for a moment has not breathed.
    """
    return tuple(
        replace(state, is_inside=False)
        if state.stage in _OVER
        else ConditionState(settled_at=state.settled_at, held_since_us=state.held_since_us, holds=state.holds)
        for state in states
    )


def left(states: tuple[ConditionState, ...]) -> tuple[ConditionState, ...]:
    """Return what is remembered while the gate as a whole is not inside: who was inside has to enter again."""
    return tuple(replace(state, is_inside=False) for state in states)


def signal_of(choice: SignalChoice, motion: Motion) -> float:
    """Pick a signal [mm, l of the volume]; NaN where the measurement has no such cell, point or region."""
    match choice.signal:
        case GateSignal.VOLUME:
            return float(motion.volume_l)
        case GateSignal.REGION:
            return _cell_mm(choice, motion)
        case GateSignal.POINT:
            return float(motion.points_mm[choice.index]) if choice.index < len(motion.points_mm) else math.nan
        case GateSignal.NAMED:
            return float(motion.named_mm[choice.index]) if choice.index < len(motion.named_mm) else math.nan
    return float(getattr(motion, f"{choice.signal}_mm"))


def _cell_mm(choice: SignalChoice, motion: Motion) -> float:
    rows, columns = motion.regions_mm.shape
    row, column = choice.row, choice.column
    if row is None or column is None or row >= rows or column >= columns:
        return math.nan
    return float(motion.regions_mm[row, column])


_OVER = {HoldStage.DRIFTED: HoldReason.BREATH_HOLD_DRIFTED, HoldStage.OVER: HoldReason.BREATH_HOLD_OVER}


def _begun(state: ConditionState, value: float, now_us: int) -> ConditionState:
    """Begin to settle, at this frame."""
    return replace(state, stage=HoldStage.SETTLING, since_us=now_us, lowest=value, highest=value, is_inside=False)


def _outside(state: ConditionState, reason: HoldReason | None, detail: str) -> WindowVerdict:
    return WindowVerdict(is_inside=False, states=(replace(state, is_inside=False),), reason=reason, detail=detail)


def _check_choice(choice: SignalChoice) -> None:
    """Refuse a cell or point off the grid, and a place where the signal has none."""
    has_place = choice.signal in {GateSignal.REGION, GateSignal.POINT}
    for name, value, size in (("row", choice.row, ROI_ROWS), ("column", choice.column, ROI_COLUMNS)):
        if not has_place:
            if value is not None:
                raise InvalidValueError(name, value, "absent unless signal is region or point")
        elif isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < size:
            raise InvalidValueError(name, value, f"a whole number from 0 to {size - 1}")


def _check_number(name: str, value: object, low: float, high: float) -> None:
    # Written so that NaN fails: every comparison with it is false.
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise InvalidValueError(name, value, f"a number from {low:g} to {high:g}")
