"""What moves faster than any breath: spikes, by how far a signal bends within a third of a second.

The bend is how far the value 0.15 s ago stands over the line from 0.3 s ago to now. A breath bends by tenths of a
millimetre, a cough by its whole height. One bump bends three times, down, up, down; a patient who shifts bends twice.
All in mm and s; a volume comes here scaled to mm.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

ARM_S = 0.15
MIN_BEND_MM = 1.2
TIMES_USUAL = 7.0
SHARE_OF_AMPLITUDE = 0.1
USUAL_S = 15.0
"""Time constant over which the usual bend is learned [s]."""
SHORT_S = 1.2
MEMORY_S = 1.3
"""Bends of one sign after the other further apart than this belong to no burst [s]."""
MIN_BENDS = 3


class Sample(NamedTuple):
    """One value of the signal."""

    seconds: float
    value: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Spikes:
    """What is remembered of fast movement.

    Attributes
    ----------
    recent
        Samples of the last third of a second.
    usual, short
        Mean size of the bend, over long and over a second [mm].
    since_s
        Time the usual bend was learned over [s].
    sign, bends
        Of the burst under way: which way it bent last, and how often it has bent the other way.
    first_s, last_s
        When the burst began, and when it bent last.
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
        """Whether it has bent often enough, and of late."""
        return self.bends >= MIN_BENDS and now_s - self.last_s <= MEMORY_S


def follow_spikes(spikes: Spikes, seconds: float, value: float, amplitude: float) -> Spikes:
    """Take a frame's value; ``amplitude`` is that of a usual breath [mm], 0 where it is not known."""
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
    """Keep what is newer than a time, and the one sample before it."""
    first = 0
    while first + 1 < len(recent) and recent[first + 1].seconds <= from_s + 1e-6:
        first += 1
    return recent[first:]


def _bend(recent: tuple[Sample, ...]) -> float | None:
    """How far the middle stands over the ends [mm]; None with fewer than three samples."""
    if len(recent) < 3:
        return None
    begin, end = recent[0], recent[-1]
    middle_s = 0.5 * (begin.seconds + end.seconds)
    middle = min(recent[1:-1], key=lambda sample: abs(sample.seconds - middle_s))
    share = (middle.seconds - begin.seconds) / (end.seconds - begin.seconds)
    return middle.value - begin.value - share * (end.value - begin.value)


def _share(step_s: float, time_s: float) -> float:
    return min(1.0, step_s / max(time_s, step_s, 1e-9))
