"""Breathing with labelled episodes: cough, sigh, apnoea, talking, irregular breathing, drift.

Regular breaths come before and between the episodes, so that the breathing monitor can learn the usual breath and
recover. Signals are in mm, inhale positive (`lab.phantom.breathing`).
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from lab.phantom.breathing import REGULAR, Habit, Signals, breath_shape
from lab.phantom.builds import Build

Grid = npt.NDArray[np.float64]
_Shape = Callable[[Grid], Grid]
KINDS = ("sigh", "apnoea", "talking", "irregular", "drift", "cough")
"""In this order; cough comes last because its speed may lose the measurement."""
QUIET_S = 16.0
"""Shortest regular breathing between two episodes [s]."""
TAIL_S = 3.0
LONGEST_S = {"cough": 4.0, "sigh": 10.0, "apnoea": 26.0, "talking": 32.0, "irregular": 40.0, "drift": 32.0}
"""Longest duration of each kind; an episode begins only if that much of the recording is left [s]."""
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
"""Habit of irregular breathing, without periodicity."""
RISE_SHARE = 0.4225
"""Phase of the peak of a regular breath, as a share of its length."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Episode:
    """A labelled episode between two times [s]; ``detail`` holds its parameters."""

    kind: str
    start_s: float
    end_s: float
    detail: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Course:
    """Breathing with episodes: signals, labels, and the times of end of inhale [s]."""

    signals: Signals
    episodes: tuple[Episode, ...]
    peaks_s: Grid


class _Breaths:
    """Builds the abdomen's signal breath by breath."""

    def __init__(self, build: Build, time_s: Grid, rng: np.random.Generator) -> None:
        self._build, self._time_s, self._rng = build, time_s, rng
        self._lift = np.zeros(len(time_s))
        self.at_s = float(time_s[0]) - build.period_s * float(rng.uniform(0.0, 1.0))
        self.peaks_s: list[float] = []

    def breathe(self, habit: Habit = REGULAR, *, times: float = 1.0, longer: float = 1.0) -> None:
        """Append one breath; ``times`` scales its depth, ``longer`` its length."""
        period, amplitude = np.clip(self._rng.standard_normal(2), -2.5, 2.5)
        is_pause = self._rng.random() < habit.pause_odds
        length = self._build.period_s * longer * max(0.45, 1.0 + habit.period_spread * float(period))
        depth = self._build.amplitude_mm * times * max(0.3, 1.0 + habit.amplitude_spread * float(amplitude))
        self._write(length, lambda phase: depth * breath_shape(phase))
        self.peaks_s.append(self.at_s + RISE_SHARE * length)
        self.at_s += length * (1.5 if is_pause else 1.0)

    def talk(self) -> None:
        """Append a breath of speech: fast inhale, long and uneven exhale."""
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
        """Append a span without breathing [s]."""
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
    """Generate regular breathing with one episode of each kind, as far as the time allows.

    Parameters
    ----------
    time_s
        Sampling times of the signals [s].
    seconds
        Length of the recording [s]: the last episode ends before it.
    quiet_s
        Regular breathing between two episodes [s].
    first_s
        Regular breathing before the first episode [s]; ``quiet_s`` by default.
    drift_mm_s
        Rate of the drift with its sign [mm/s]; random by default.
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
    """Append a sigh, an apnoea, talking or irregular breathing."""
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
    """Two to four coughs: the episode and the signal to add [mm]."""
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
    """Linear baseline drift to a new level: the episode and the signal to add [mm]."""
    drawn = float(rng.uniform(*DRIFT_MM_S)) * (1.0 if rng.random() < 0.5 else -1.0)
    rate = drawn if rate_mm_s is None else rate_mm_s
    lasts_s = min(30.0, MAX_DRIFT_MM / abs(rate))
    ramp = rate * np.clip(time_s - start_s, 0.0, lasts_s)
    return Episode(kind="drift", start_s=start_s, end_s=start_s + lasts_s, detail={"mm_s": rate}), ramp
