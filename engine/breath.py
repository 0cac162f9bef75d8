"""The words of breathing: which signal, where in the breath the patient is, and what happens that is no quiet breath.

Below frames, because a measurement carries them; how they are worked out is :mod:`engine.stages.breathing`.
"""

import enum
from dataclasses import dataclass

from engine.errors import InvalidValueError


class GateSignal(enum.StrEnum):
    """Which motion is gated on."""

    WHOLE = "whole"
    THORAX = "thorax"
    ABDOMEN = "abdomen"
    REGION = "region"
    NAMED = "named"
    POINT = "point"
    VOLUME = "volume"


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalChoice:
    """One signal of a measurement.

    Attributes
    ----------
    signal
        Which; a plain string of the same value is accepted.
    row, column
        Cell of the region grid for ``region``; grid point for ``point``.
    name
        Of a named region, for ``named``.
    index
        Where a point or a named region stands among those the pipeline measures.
    """

    signal: GateSignal | str = GateSignal.WHOLE
    row: int | None = None
    column: int | None = None
    name: str | None = None
    index: int = 0

    def __post_init__(self) -> None:
        """Refuse a signal that does not exist."""
        if self.signal not in set(GateSignal):
            raise InvalidValueError("signal", self.signal, f"one of {', '.join(GateSignal)}")
        object.__setattr__(self, "signal", GateSignal(self.signal))
        if isinstance(self.index, bool) or not isinstance(self.index, int) or self.index < 0:
            raise InvalidValueError("index", self.index, "a whole number from 0")
        has_name = self.name is not None
        if has_name != (self.signal is GateSignal.NAMED):
            raise InvalidValueError("name", self.name, "given for signal named, and for no other")

    @property
    def is_volume(self) -> bool:
        """Whether its values are litres, not millimetres."""
        return self.signal is GateSignal.VOLUME

    @property
    def label(self) -> str:
        """Name it for a person."""
        if self.signal in {GateSignal.REGION, GateSignal.POINT}:
            return f"{self.signal} {self.row},{self.column}"
        return self.name or str(self.signal)


WHOLE = SignalChoice()


class BreathEventKind(enum.StrEnum):
    """What a breath can be beside quiet; the value is the stable code."""

    COUGH = "cough"
    SIGH = "sigh"
    APNOEA = "apnoea"
    TALKING = "talking"
    IRREGULAR = "irregular"
    DRIFT = "drift"


@dataclass(frozen=True, slots=True, kw_only=True)
class BreathEvent:
    """Something that is under way; ``start_us`` is device time, ``confidence`` from 0 to 1."""

    kind: BreathEventKind
    start_us: int
    confidence: float
    detail: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Breath:
    """Where one signal stands in the breath; values are mm, or l of a volume. None is "cannot tell".

    Attributes
    ----------
    phase_percent
        0 at the end of inhale, about 50 at the end of exhale, below 100 [%]: the convention of 4-D CT.
    phase_confidence, rate_confidence
        From 0 to 1.
    note
        Why there is no phase; empty when there is one.
    rate_per_min
        Breaths a minute.
    amplitude
        From the end of exhale to the end of inhale, of the last breaths.
    baseline
        Level of the end of exhale, of the last breaths.
    drift
        How far the baseline is from where it was learned.
    drift_per_s
        How fast it moves.
    regularity
        How much a breath is like those before it, 0 to 1.
    events
        What is under way, the newest last.
    """

    signal: SignalChoice = WHOLE
    phase_percent: float | None = None
    phase_confidence: float = 0.0
    note: str = "too little seen yet"
    rate_per_min: float | None = None
    rate_confidence: float = 0.0
    amplitude: float | None = None
    baseline: float | None = None
    drift: float | None = None
    drift_per_s: float | None = None
    regularity: float | None = None
    events: tuple[BreathEvent, ...] = ()
