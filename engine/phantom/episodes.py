"""What a patient does beside quiet breathing, laid out in time with labels: cough, sigh, apnoea, talking, drift.

Quiet breaths come first and between, so that whoever watches can learn what is usual and find back to it. Signals are
mm, inhale positive; see :mod:`engine.phantom.breathing`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from engine.phantom.breathing import REGULAR, Habit, Signals, breath_shape
from engine.phantom.builds import Build

Grid = npt.NDArray[np.float64]
_Shape = Callable[[Grid], Grid]
KINDS = ("sigh", "apnoea", "talking", "irregular", "drift", "cough")
"""In this order: no skin moves as fast as in a hard cough, and what is measured after it has to be believed again."""
QUIET_S = 16.0
"""Shortest quiet breathing between two episodes [s]."""
TAIL_S = 3.0
LONGEST_S = {"cough": 4.0, "sigh": 10.0, "apnoea": 26.0, "talking": 32.0, "irregular": 40.0, "drift": 32.0}
"""An episode begins only if so much of the recording is left [s]."""
COUGH_MM = (5.0, 20.0)
SPIKE_S = (0.2, 0.4)
COUGH_CHEST_SHARE = 0.6
APNOEA_S = (10.0, 20.0)
SIGH_TIMES = (1.9, 2.3)
TALK_IN_S = (0.35, 0.6)
TALK_OUT_S = (3.0, 5.5)
DRIFT_MM_S = (0.1, 0.74)
MAX_DRIFT_MM = 8.0
LOST = Habit(amplitude_spread=0.45, period_spread=0.35, share_spread=0.0, pause_odds=0.15)
"""Lost periodicity: no breath is like the one before."""
RISE_SHARE = 0.4225
"""Where a quiet breath is highest, as a share of its length."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Episode:
    """Something that happens between two times [s]."""

    kind: str
    start_s: float
    end_s: float
    detail: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Course:
    """Breathing with episodes: the signals, the labels, and when each inhale ended [s]."""

    signals: Signals
    episodes: tuple[Episode, ...]
    peaks_s: Grid


class _Breaths:
    """Breaths written one after the other."""

    def __init__(self, build: Build, time_s: Grid, rng: np.random.Generator) -> None:
        self._build, self._time_s, self._rng = build, time_s, rng
        self._lift = np.zeros(len(time_s))
        self.at_s = float(time_s[0]) - build.period_s * float(rng.uniform(0.0, 1.0))
        self.peaks_s: list[float] = []

    def breathe(self, habit: Habit = REGULAR, *, times: float = 1.0, longer: float = 1.0) -> None:
        """Add one breath."""
        period, amplitude = np.clip(self._rng.standard_normal(2), -2.5, 2.5)
        is_pause = self._rng.random() < habit.pause_odds
        length = self._build.period_s * longer * max(0.45, 1.0 + habit.period_spread * float(period))
        depth = self._build.amplitude_mm * times * max(0.3, 1.0 + habit.amplitude_spread * float(amplitude))
        self._write(length, lambda phase: depth * breath_shape(phase))
        self.peaks_s.append(self.at_s + RISE_SHARE * length)
        self.at_s += length * (1.5 if is_pause else 1.0)

    def talk(self) -> None:
        """Add a breath of someone who speaks: quick in, long and uneven out."""
        rise_s, fall_s = float(self._rng.uniform(*TALK_IN_S)), float(self._rng.uniform(*TALK_OUT_S))
        length = rise_s + fall_s
        depth = self._build.amplitude_mm * float(self._rng.uniform(0.75, 1.25))
        words_hz, start = float(self._rng.uniform(1.2, 2.2)), float(self._rng.uniform(0.0, 1.0))

        def shape(phase: Grid) -> Grid:
            now_s = phase * length
            out = np.clip((now_s - rise_s) / fall_s, 0.0, 1.0)
            words = 0.05 * np.sin(2.0 * np.pi * (words_hz * now_s + start)) * np.sin(np.pi * out)
            fall = 1.0 - out - 0.08 * np.sin(2.0 * np.pi * out)
            return np.asarray(
                depth * np.where(now_s < rise_s, 0.5 - 0.5 * np.cos(np.pi * now_s / rise_s), fall + words)
            )

        self._write(length, shape)
        self.peaks_s.append(self.at_s + rise_s)
        self.at_s += length

    def rest(self, seconds: float) -> None:
        """Breathe not at all."""
        self.at_s += seconds

    def _write(self, length: float, shape: _Shape) -> None:
        inside = (self._time_s >= self.at_s) & (self._time_s < self.at_s + length)
        self._lift[inside] = shape((self._time_s[inside] - self.at_s) / length)

    @property
    def lift_mm(self) -> Grid:
        """The abdomen's signal [mm]."""
        return self._lift


def lay_out_course(
    build: Build,
    time_s: Grid,
    seconds: float,
    rng: np.random.Generator,
    *,
    kinds: tuple[str, ...] = KINDS,
    quiet_s: float = QUIET_S,
    first_s: float | None = None,
    drift_mm_s: float | None = None,
) -> Course:
    """Breathe quietly for ``quiet_s``, then one episode of each kind with as much quiet between, while there is time.

    Parameters
    ----------
    time_s
        Where the signals are wanted [s].
    seconds
        The recording's length: the last episode ends before it.
    first_s
        How long the quiet before the first episode is; ``quiet_s`` when not given.
    drift_mm_s
        How fast the drift is; drawn when not given, with its sign.
    """
    breaths = _Breaths(build, time_s, rng)
    episodes: list[Episode] = []
    offset, spikes = np.zeros(len(time_s)), np.zeros(len(time_s))
    quiet_until_s = quiet_s if first_s is None else first_s
    for kind in kinds:
        while breaths.at_s < quiet_until_s:
            breaths.breathe()
        if breaths.at_s + LONGEST_S[kind] + TAIL_S > seconds:
            continue
        if kind == "cough":
            episode, burst = _cough(time_s, breaths.at_s + float(rng.uniform(0.0, build.period_s)), rng)
            spikes += burst
        elif kind == "drift":
            episode, ramp = _drift(time_s, breaths.at_s + float(rng.uniform(0.0, build.period_s)), rng, drift_mm_s)
            offset += ramp
        else:
            episode = _breathed(kind, breaths, rng)
        episodes.append(episode)
        quiet_until_s = episode.end_s + quiet_s
    while breaths.at_s < time_s[-1]:
        breaths.breathe()
    wander = REGULAR.wander_mm * np.sin(2.0 * np.pi * time_s / 31.0 + rng.uniform(0.0, 6.0))
    lift = breaths.lift_mm
    signals = Signals(
        time_s=time_s,
        abdomen_mm=lift + offset + spikes + wander,
        thorax_mm=build.thorax_share * lift + offset + COUGH_CHEST_SHARE * spikes + wander,
    )
    return Course(signals=signals, episodes=tuple(episodes), peaks_s=np.array(breaths.peaks_s))


def _breathed(kind: str, breaths: _Breaths, rng: np.random.Generator) -> Episode:
    """Write an episode that is made of breaths, or of none."""
    start_s = breaths.at_s
    match kind:
        case "sigh":
            times = float(rng.uniform(*SIGH_TIMES))
            breaths.breathe(times=times, longer=1.35)
            return Episode(kind=kind, start_s=start_s, end_s=breaths.at_s, detail={"times": times})
        case "apnoea":
            breaths.rest(float(rng.uniform(*APNOEA_S)))
        case "talking":
            until_s = start_s + float(rng.uniform(18.0, 24.0))
            while breaths.at_s < until_s:
                breaths.talk()
        case _:
            while breaths.at_s < start_s + 32.0:
                breaths.breathe(LOST)
    return Episode(kind=kind, start_s=start_s, end_s=breaths.at_s)


def _cough(time_s: Grid, start_s: float, rng: np.random.Generator) -> tuple[Episode, Grid]:
    """Cough two to four times."""
    burst, at_s = np.zeros(len(time_s)), start_s
    coughs = int(rng.integers(2, 5))
    for _ in range(coughs):
        width_s = float(rng.uniform(*SPIKE_S))
        share = np.clip((time_s - at_s) / width_s, 0.0, 1.0)
        burst += float(rng.uniform(*COUGH_MM)) * (0.5 - 0.5 * np.cos(2.0 * np.pi * share))
        end_s = at_s + width_s
        at_s = end_s + float(rng.uniform(0.05, 0.3))
    return Episode(kind="cough", start_s=start_s, end_s=end_s, detail={"coughs": float(coughs)}), burst


def _drift(time_s: Grid, start_s: float, rng: np.random.Generator, rate_mm_s: float | None) -> tuple[Episode, Grid]:
    """Let the end of exhale move on steadily, and stay where it came to."""
    drawn = float(rng.uniform(*DRIFT_MM_S)) * (1.0 if rng.random() < 0.5 else -1.0)
    rate = drawn if rate_mm_s is None else rate_mm_s
    lasts_s = min(30.0, MAX_DRIFT_MM / abs(rate))
    ramp = rate * np.clip(time_s - start_s, 0.0, lasts_s)
    return Episode(kind="drift", start_s=start_s, end_s=start_s + lasts_s, detail={"mm_s": rate}), ramp
