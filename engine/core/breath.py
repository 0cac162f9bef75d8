"""Values of breathing: the choice of a signal, its phase and rate, and breathing events.

In core because a measurement contains them; :mod:`engine.motion.breathing` computes them.
"""

import enum
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from operator import attrgetter
from typing import Any

from engine.core.errors import InvalidValueError
from engine.core.sentences import say

LITRES_PER_MM = 0.1
"""Volume that counts as a millimetre where a bound is given in mm: a region of 350 mm by 300 mm that rises by 1 mm."""


class GateSignal(enum.StrEnum):
    """The kinds of signals for gating."""

    WHOLE = "whole"
    THORAX = "thorax"
    ABDOMEN = "abdomen"
    REGION = "region"
    NAMED = "named"
    POINT = "point"
    VOLUME = "volume"


_FIELDS = {
    GateSignal.WHOLE: ("whole_mm", "whole"),
    GateSignal.THORAX: ("thorax_mm", "thorax"),
    GateSignal.ABDOMEN: ("abdomen_mm", "abdomen"),
    GateSignal.VOLUME: ("volume_l", "whole"),
    GateSignal.REGION: ("regions_mm", "cells"),
    GateSignal.POINT: ("points_mm", "points"),
    GateSignal.NAMED: ("named_mm", "named"),
}
"""Where a signal's value is in a `Motion`, and its share in `SeenShares`."""
_PARTS = {GateSignal.REGION, GateSignal.POINT, GateSignal.NAMED}


@dataclass(frozen=True, kw_only=True)
class SignalChoice:
    """One signal of a measurement.

    Attributes
    ----------
    signal
        Kind of signal; a plain string of the same value is accepted.
    row, column
        Cell of the region grid for ``region``; grid point for ``point``.
    name
        Name of the region, for ``named``.
    index
        Position of a point or a named region among those the pipeline measures.
    """

    signal: GateSignal | str = GateSignal.WHOLE
    row: int | None = None
    column: int | None = None
    name: str | None = None
    index: int = 0

    def __post_init__(self) -> None:
        """Raise InvalidValueError for a signal that does not exist."""
        if self.signal not in set(GateSignal):
            raise InvalidValueError("signal", self.signal, f"one of {', '.join(GateSignal)}")
        object.__setattr__(self, "signal", GateSignal(self.signal))
        if isinstance(self.index, bool) or not isinstance(self.index, int) or self.index < 0:
            raise InvalidValueError("index", self.index, "a whole number from 0")
        if (self.name is not None) != (self.signal is GateSignal.NAMED):
            raise InvalidValueError("name", self.name, "given for signal named, and for no other")

    def __getstate__(self) -> dict[str, object]:
        """Give the fields alone: what is remembered beside them does not go to another process with every sample."""
        return {name: self.__dict__[name] for name in self.__dataclass_fields__}

    @cached_property
    def is_volume(self) -> bool:
        """Whether its values are litres, not millimetres."""
        return self.signal is GateSignal.VOLUME

    @cached_property
    def unit(self) -> str:
        """Unit of its values, for display."""
        return "l" if self.is_volume else "mm"

    @cached_property
    def per_mm(self) -> float:
        """What of its unit counts as a millimetre."""
        return LITRES_PER_MM if self.is_volume else 1.0

    @cached_property
    def is_wide(self) -> bool:
        """Whether it is of a large part of the region: the whole, a half, or the volume."""
        return self.signal not in _PARTS

    @cached_property
    def value_in(self) -> Callable[[object], float]:
        """Its value in a `Motion` [mm, l of the volume]; NaN where that has no such cell, point or region."""
        return self._reader(0)

    @cached_property
    def seen_in(self) -> Callable[[object], float]:
        """The share of its area in `SeenShares` that was seen, 0 to 1; NaN where it is unknown."""
        return self._reader(1)

    def _reader(self, at: int) -> Callable[[object], float]:
        get = attrgetter(_FIELDS[GateSignal(self.signal)][at])
        if self.signal is GateSignal.REGION:
            return partial(_at_cell, get, self.row, self.column)
        return get if self.is_wide else partial(_at_index, get, self.index)

    @property
    def label(self) -> str:
        """Name of the signal, for display."""
        if self.signal in {GateSignal.REGION, GateSignal.POINT}:
            return f"{self.signal} {self.row},{self.column}"
        return self.name or self.signal


def _at_cell(get: Callable[[object], Any], row: int | None, column: int | None, of: object) -> float:
    cells = get(of)
    rows, columns = cells.shape
    if row is None or column is None or row >= rows or column >= columns:
        return math.nan
    return float(cells[row, column])


def _at_index(get: Callable[[object], Sequence[float]], index: int, of: object) -> float:
    values = get(of)
    return float(values[index]) if index < len(values) else math.nan


WHOLE = SignalChoice()


class BreathEventKind(enum.StrEnum):
    """Kinds of breathing events; the value is the stable code."""

    COUGH = "cough"
    SIGH = "sigh"
    APNOEA = "apnoea"
    TALKING = "talking"
    IRREGULAR = "irregular"
    NO_CYCLE = "no_cycle"
    DRIFT = "drift"


@dataclass(frozen=True, slots=True, kw_only=True)
class BreathEvent:
    """A breathing event in progress; ``start_us`` is device time [us], ``confidence`` from 0 to 1."""

    kind: BreathEventKind
    start_us: int
    confidence: float
    detail: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Breath:
    """Breathing of one signal; values are mm, or l of a volume. None where a value cannot be determined.

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
        Excursion from the end of exhale to the end of inhale, of the last breaths.
    baseline
        Level of the end of exhale, of the last breaths.
    drift
        Distance of the baseline from that of the training.
    exhale_us, exhale_drift
        Device time of the last end of exhale [us], also one before a gap, and its distance from that of the training;
        where the present exhale already lies lower, that of its lowest level.
    drift_per_s
        Rate of the drift [mm/s or l/s].
    regularity
        Similarity of the breath to earlier ones, 0 to 1.
    events
        Events in progress, the newest last.
    """

    signal: SignalChoice = WHOLE
    phase_percent: float | None = None
    phase_confidence: float = 0.0
    note: str = say("too little seen yet")
    rate_per_min: float | None = None
    rate_confidence: float = 0.0
    amplitude: float | None = None
    baseline: float | None = None
    drift: float | None = None
    exhale_us: int | None = None
    exhale_drift: float | None = None
    drift_per_s: float | None = None
    regularity: float | None = None
    events: tuple[BreathEvent, ...] = ()
