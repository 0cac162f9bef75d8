"""Breathing signals of chest and abdomen in mm against time in s, inhale positive, 0 at rest.

A signal is sampled on a fine time grid and interpolated by a cubic spline, so it can be read at any delay. One breath
is ``cos^4`` in a warped phase: inhale is faster than exhale, with a long rest at the end of exhale (Lujan et al. 1999,
doi:10.1118/1.598577).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from engine.core.frames import FloatArray
from lab.phantom.builds import Build

Grid = npt.NDArray[np.float64]
STEP_S = 0.02
# How much higher the shirt's folds stand on inhale, as a share of a crease, and half the stroke of the heart.
FOLDS_MM = 0.7
HEART_MM = 0.15
LEAD_S = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Habit:
    """Variability of a person's breathing.

    Attributes
    ----------
    amplitude_spread, period_spread, share_spread
        Standard deviation of a breath's amplitude, length and thorax share, as a share of the mean.
    wander_mm
        Standard deviation of the slow wander of the end of exhale.
    sigh_odds, pause_odds
        Odds that a breath is a sigh (nearly twice as deep) or that a pause follows.
    """

    amplitude_spread: float = 0.04
    period_spread: float = 0.03
    share_spread: float = 0.03
    wander_mm: float = 0.05
    sigh_odds: float = 0.0
    pause_odds: float = 0.0


REGULAR = Habit()
IRREGULAR = Habit(
    amplitude_spread=0.22, period_spread=0.18, share_spread=0.15, wander_mm=0.8, sigh_odds=0.07, pause_odds=0.10
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Signals:
    """Abdomen and thorax [mm] at ``time_s``, all of shape (n,)."""

    time_s: Grid
    abdomen_mm: Grid
    thorax_mm: Grid


class Breathing:
    """Converts the two signals to the weights of the body's eight motion fields at any time."""

    def __init__(self, signals: Signals, build: Build) -> None:
        self._abdomen = CubicSpline(signals.time_s, signals.abdomen_mm)
        self._thorax = CubicSpline(signals.time_s, signals.thorax_mm)
        self._first_s, self._last_s = float(signals.time_s[0]), float(signals.time_s[-1])
        late = 1.3 * build.spread_lag_s * np.array([0.0, 0.5, 1.0])
        self._delays_s = np.concatenate([late, build.thorax_lag_s + late])
        self._amplitude_mm = build.amplitude_mm
        # The heart rate only has to be no harmonic of the breathing rate.
        self._pulse_hz = 1.35 - 0.012 * build.bmi

    def weights(self, time_s: FloatArray | float) -> Grid:
        """Return a_k(t) [mm], shape (..., 8)."""
        now = np.asarray(time_s, dtype=np.float64)[..., None]
        times = np.clip(now - self._delays_s, self._first_s, self._last_s)
        abdomen = self._abdomen(times[..., :3])
        folds = FOLDS_MM * np.tanh((abdomen[..., 1:2] / self._amplitude_mm) ** 2)
        turn = 2.0 * np.pi * self._pulse_hz * now
        heart = HEART_MM * (np.sin(turn) + 0.5 * np.sin(2.0 * turn + 0.8))
        return np.concatenate([abdomen, self._thorax(times[..., 3:]), folds, heart], axis=-1)


def time_grid(seconds: float) -> Grid:
    """Return the sampling times from `LEAD_S` before the recording to `LEAD_S` after it [s]."""
    return np.arange(-LEAD_S, seconds + LEAD_S, STEP_S)


def breathe(build: Build, habit: Habit, time_s: Grid, rng: np.random.Generator) -> Signals:
    """Generate free breathing of one person at ``time_s``."""
    starts, lengths, amplitudes, shares = _breaths(build, habit, time_s, rng)
    which = np.clip(np.searchsorted(starts, time_s, side="right") - 1, 0, len(starts) - 1)
    phase = np.clip((time_s - starts[which]) / lengths[which], 0.0, 1.0)
    shape = breath_shape(phase)
    abdomen = build.amplitude_mm * amplitudes[which] * shape
    thorax = build.amplitude_mm * build.thorax_share * amplitudes[which] * shares[which] * shape
    wander = habit.wander_mm * _wander(time_s, rng)
    return Signals(time_s=time_s, abdomen_mm=abdomen + wander, thorax_mm=thorax + 0.6 * wander)


def breath_shape(phase: Grid) -> Grid:
    """One breath, from 0 over 1 back to 0, flat at both ends; in takes 42 % of it."""
    warped = phase + 0.55 * phase * (1.0 - phase) ** 2
    return np.asarray(np.sin(np.pi * warped) ** 4)


def _breaths(build: Build, habit: Habit, time_s: Grid, rng: np.random.Generator) -> tuple[Grid, Grid, Grid, Grid]:
    starts, lengths, amplitudes, shares = [], [], [], []
    # The first breath begins before the recording, at a random phase.
    at = float(time_s[0]) - build.period_s * float(rng.uniform(0.0, 1.0))
    while at < time_s[-1]:
        draws = np.clip(rng.standard_normal(3), -2.5, 2.5)
        is_sigh, is_pause = rng.random(2) < (habit.sigh_odds, habit.pause_odds)
        length = build.period_s * max(0.45, 1.0 + habit.period_spread * draws[0]) * (1.35 if is_sigh else 1.0)
        starts.append(at)
        lengths.append(length)
        amplitudes.append(max(0.3, 1.0 + habit.amplitude_spread * draws[1]) * (1.8 if is_sigh else 1.0))
        shares.append(max(0.3, 1.0 + habit.share_spread * draws[2]))
        at += length * (1.5 if is_pause else 1.0)
    return np.array(starts), np.array(lengths), np.array(amplitudes), np.array(shares)


def _wander(time_s: Grid, rng: np.random.Generator) -> Grid:
    """Slow wander of unit variance: a few waves far slower than a breath."""
    periods_s = np.array([17.0, 27.0, 43.0, 71.0])
    phases = rng.uniform(0.0, 2.0 * np.pi, len(periods_s))
    return np.asarray(np.sin(2.0 * np.pi * time_s[:, None] / periods_s + phases).sum(axis=1) / np.sqrt(2.0))
