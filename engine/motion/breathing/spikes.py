"""Detects motion faster than any breath (coughs) by the bend of the signal within 0.3 s.

The bend is the distance of the value 0.15 s ago from the line between the values 0.3 s ago and now. A breath bends by
tenths of a millimetre, a cough by its whole height. One bump bends three times (down, up, down), a patient shift twice.
All in mm and s; a volume is scaled to mm.
"""

from dataclasses import dataclass
from typing import NamedTuple

from engine.core.replacing import replace

ARM_S = 0.15
MIN_BEND_MM = 1.2
TIMES_USUAL = 7.0
SHARE_OF_AMPLITUDE = 0.1
USUAL_S = 15.0
"""Time constant over which the usual bend is learned [s]."""
SHORT_S = 1.2
MEMORY_S = 1.3
"""Longest time between two bends of a burst [s]."""
MIN_BENDS = 3


class Sample(NamedTuple):
    """One value of the signal."""

    seconds: float
    value: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Spikes:
    """State of the detector.

    Attributes
    ----------
    recent
        Samples of the last 0.3 s.
    usual, short
        Mean size of the bend over a long time and over about one second [mm].
    since_s
        Time over which the usual bend was learned [s].
    sign, bends
        Sign of the current burst's last bend, and the number of its bends of alternating sign.
    first_s, last_s
        Start of the burst, and its last bend [s].
    """

    recent: tuple[Sample, ...] = ()
    usual: float = 0.0
    short: float = 0.0
    since_s: float = 0.0
    sign: int = 0
    bends: int = 0
    first_s: float = 0.0
    last_s: float = -1e9

    def is_cough(self, now_s: float) -> bool:
        """Whether the current burst has enough bends and the last is recent."""
        return self.bends >= MIN_BENDS and now_s - self.last_s <= MEMORY_S


def follow_spikes(spikes: Spikes, seconds: float, value: float, amplitude: float) -> Spikes:
    """Add a frame's value; ``amplitude`` is that of a usual breath [mm], 0 if unknown."""
    recent = (*_since(spikes.recent, seconds - 2.0 * ARM_S), Sample(seconds, value))
    bend = _bend(recent)
    if bend is None:
        return replace(spikes, recent=recent)
    size = abs(bend)
    limit = max(MIN_BEND_MM, TIMES_USUAL * spikes.usual, SHARE_OF_AMPLITUDE * amplitude)
    step_s = seconds - recent[-2].seconds
    learned = replace(
        spikes,
        recent=recent,
        usual=spikes.usual + _share(step_s, min(USUAL_S, spikes.since_s + step_s)) * (min(size, limit) - spikes.usual),
        short=spikes.short + _share(step_s, SHORT_S) * (min(size, limit) - spikes.short),
        since_s=min(spikes.since_s + step_s, USUAL_S),
    )
    return _counted(learned, seconds, 1 if bend > 0.0 else -1) if size > limit else learned


def _counted(spikes: Spikes, seconds: float, sign: int) -> Spikes:
    if seconds - spikes.last_s > MEMORY_S:
        return replace(spikes, sign=sign, bends=1, first_s=seconds, last_s=seconds)
    return replace(spikes, sign=sign, bends=spikes.bends + (sign != spikes.sign), last_s=seconds)


def _since(recent: tuple[Sample, ...], from_s: float) -> tuple[Sample, ...]:
    """Keep the samples after a time, and the last one before it."""
    first = 0
    while first + 1 < len(recent) and recent[first + 1].seconds <= from_s + 1e-6:
        first += 1
    return recent[first:]


def _bend(recent: tuple[Sample, ...]) -> float | None:
    """Distance of the middle sample from the line between first and last [mm]; None for fewer than three samples."""
    if len(recent) < 3:
        return None
    begin, end = recent[0], recent[-1]
    middle_s = 0.5 * (begin.seconds + end.seconds)
    apart_s = [abs(sample.seconds - middle_s) for sample in recent[1:-1]]
    middle = recent[1 + apart_s.index(min(apart_s))]
    share = (middle.seconds - begin.seconds) / (end.seconds - begin.seconds)
    return middle.value - begin.value - share * (end.value - begin.value)


def _share(step_s: float, time_s: float) -> float:
    return min(1.0, step_s / max(time_s, step_s, 1e-9))
