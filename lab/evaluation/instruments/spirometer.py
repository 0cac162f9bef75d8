"""Comparison of Tidegate's volume with a spirometer's (article, sections 4.5.1 and 5.1, Fig. 11).

As in the article, a b-spline interpolates the spirometer's samples, both volumes are scaled to -1..1 and correlated.
Since the instruments have no common clock, the lag is estimated first, and reported.

Most spirometers give flow, whose integral drifts: an offset of 0.02 l/s is a litre in 50 s. A baseline is therefore
subtracted from both volumes alike: a piecewise linear curve with a knot per minute through the ends of exhale, below at
least 9 of 10 samples (asymmetric least squares, Eilers and Boelens 2005). A breath hold does not bend it; a slow change
of the patient's rest position does, which flow cannot show either. With volume instead of flow nothing is subtracted.

The lag is the spirometer's time minus the recording's: an event ``t`` seconds after the first depth frame is at
``t + lag_s`` in the file. It maximises the correlation of the *changes* of both volumes over half a second, which drift
does not affect. Regular breathing also fits at a lag one breath later; the comparison then reports this rival lag.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.optimize import minimize_scalar

from engine.core.errors import InvalidValueError
from engine.core.frames import BoolArray, FloatArray
from lab.evaluation.instruments.agreement import correlation
from lab.evaluation.instruments.flow_file import Spirometry

MAX_LAG_S = 5.0
WIDEST_LAG_S = 120.0
MIN_OVERLAP_S = 8.0
PIECE_S = 60.0
LAG_STEP_S = 0.05
RIVAL_AWAY_S = 1.0
RIVAL_RATIO = 2.0
"""A lag is a rival if its unexplained share is less than this multiple of the best lag's."""
UPSIDE_MARGIN = 0.01
CHANGE_S = 0.5
_COARSE_HZ = 10.0
_BELOW = 0.03
_ROUNDS = 40


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SpirometerComparison:
    """Both volumes over the time that both instruments measured.

    Attributes
    ----------
    lag_s
        Spirometer's time minus the recording's [s].
    correlation
        Correlation of both volumes.
    scale
        Slope of Tidegate's volume over the spirometer's, least squares.
    error_percent, error_deviation_percent
        Mean and standard deviation of the absolute difference after that scale, in per cent of the range (5th to 95th
        percentile).
    overlap_s
        Time in which both measured [s].
    tidegate_l, spirometer_l
        Both volumes in each frame of the recording [l], baseline subtracted if flow was given, shape (n,); NaN
        where either did not measure.
    rival_lag_s
        Another lag that fits nearly as well [s]; None if there is none.
    notices
        Warnings for the user.
    """

    lag_s: float
    correlation: float
    scale: float
    error_percent: float
    error_deviation_percent: float
    overlap_s: float
    tidegate_l: FloatArray
    spirometer_l: FloatArray
    rival_lag_s: float | None = None
    notices: list[str] = field(default_factory=list)


def compare_volumes(
    time_s: FloatArray,
    volume_l: FloatArray,
    spirometry: Spirometry,
    *,
    max_lag_s: float = MAX_LAG_S,
    is_exhale_positive: bool = False,
) -> SpirometerComparison:
    """Estimate the lag and compare the volumes.

    Parameters
    ----------
    time_s
        Times of the depth frames since the first one [s], shape (n,).
    volume_l
        Tidegate's volume [l], shape (n,); NaN where it did not measure.
    max_lag_s
        Largest lag searched in both directions [s].
    is_exhale_positive
        Whether the spirometer's sign is positive for exhaled air.

    Raises
    ------
    InvalidValueError
        The common time is too short, or the lag exceeds ``max_lag_s``.
    """
    check_max_lag(max_lag_s)
    measured = np.isfinite(volume_l)
    spline = _volume_of(spirometry, is_exhale_positive)
    search = _Search(time_s[measured], volume_l[measured], spline, spirometry)
    lags = np.arange(-max_lag_s, max_lag_s + 0.5 * LAG_STEP_S, LAG_STEP_S)
    fits = np.array([search.fit(lag) for lag in lags])
    if not np.isfinite(fits).any():
        raise InvalidValueError(
            "overlap", f"{search.longest_overlap(lags):.1f} s", f"{MIN_OVERLAP_S:g} s or more within the lags allowed"
        )
    lag_s = _refined(search, lags, fits)
    inside = np.zeros(len(time_s), dtype=np.bool_)
    inside[np.flatnonzero(measured)[search.overlap(lag_s)]] = True
    tidegate = _without_baseline(time_s[inside], volume_l[inside], is_flow=spirometry.is_flow)
    spirometer_raw_l = np.asarray(spline(time_s[inside] + lag_s))
    spirometer = _without_baseline(time_s[inside], spirometer_raw_l, is_flow=spirometry.is_flow)
    return _comparison(lag_s, lags, fits, inside, tidegate, spirometer, search.overlap_s(lag_s))


def check_max_lag(max_lag_s: float) -> None:
    """Raise InvalidValueError unless the largest lag [s] is within its bounds."""
    if not 0.0 < max_lag_s <= WIDEST_LAG_S:
        raise InvalidValueError("max-lag-s", max_lag_s, f"more than 0 and at most {WIDEST_LAG_S:g}")


def to_unit_range(values: FloatArray) -> FloatArray:
    """Scale to -1..1 (article, Fig. 11), same shape; NaN stays NaN."""
    low, high = np.nanmin(values), np.nanmax(values)
    return np.asarray(2.0 * (values - low) / max(float(high - low), 1e-12) - 1.0)


def _volume_of(spirometry: Spirometry, is_exhale_positive: bool) -> BSpline:  # noqa: FBT001
    """Interpolate the samples by a cubic b-spline, and integrate it if they are flow."""
    sign = -1.0 if is_exhale_positive else 1.0
    spline = make_interp_spline(spirometry.time_s, sign * spirometry.values, k=3)
    return spline.antiderivative() if spirometry.is_flow else spline


class _Search:
    """Correlation of both volumes' changes as a function of the lag, on thinned times."""

    def __init__(self, time_s: FloatArray, volume_l: FloatArray, spline: BSpline, spirometry: Spirometry) -> None:
        if len(time_s) < 2:
            raise InvalidValueError("overlap", f"{len(time_s)} measured frames", f"{MIN_OVERLAP_S:g} s or more")
        self._time_s = time_s
        self._step_s = float(np.median(np.diff(time_s)))
        self._first_s, self._last_s = float(spirometry.time_s[0]), float(spirometry.time_s[-1])
        self._spline = spline
        at_s = time_s[:: max(int(1.0 / (_COARSE_HZ * self._step_s)), 1)]
        before, after = (_at(time_s, volume_l, at_s + half) for half in (-0.5 * CHANGE_S, 0.5 * CHANGE_S))
        is_known = np.isfinite(before) & np.isfinite(after)
        self._at_s, self._change_l = at_s[is_known], (after - before)[is_known]

    def overlap(self, lag_s: float) -> BoolArray:
        """Measured frames that the spirometer's recording covers, shape (n,)."""
        at = self._time_s + lag_s
        return np.asarray((at >= self._first_s) & (at <= self._last_s))

    def overlap_s(self, lag_s: float) -> float:
        """Time in which both measured [s]."""
        return float(np.count_nonzero(self.overlap(lag_s))) * self._step_s

    def longest_overlap(self, lags: FloatArray) -> float:
        """Return the longest overlap of any lag [s]."""
        return max(self.overlap_s(float(lag)) for lag in lags)

    def fit(self, lag_s: float) -> float:
        """Correlation of the changes at a lag; NaN if the overlap is too short."""
        if self.overlap_s(lag_s) < MIN_OVERLAP_S:
            return float("nan")
        first, last = self._at_s + lag_s - 0.5 * CHANGE_S, self._at_s + lag_s + 0.5 * CHANGE_S
        inside = (first >= self._first_s) & (last <= self._last_s)
        found = correlation(self._change_l[inside], self._spline(last[inside]) - self._spline(first[inside]))
        return float("nan") if found is None else found


def _at(time_s: FloatArray, values: FloatArray, at_s: FloatArray) -> FloatArray:
    """Interpolate linearly; NaN beyond the ends and in gaps."""
    right = np.clip(np.searchsorted(time_s, at_s), 1, len(time_s) - 1)
    is_near = (time_s[right] - time_s[right - 1] <= CHANGE_S) & (at_s >= time_s[0]) & (at_s <= time_s[-1])
    return np.where(is_near, np.interp(at_s, time_s, values), np.nan)


def _refined(search: _Search, lags: FloatArray, fits: FloatArray) -> float:
    """Refine the best lag of the coarse search [s]."""
    best = int(np.nanargmax(fits))
    if best in {0, len(lags) - 1}:
        bound = f"larger: the best match is at its limit of {lags[best]:.1f} s"
        raise InvalidValueError("max-lag-s", round(float(lags[-1]), 3), bound)
    low, high = float(lags[best - 1]), float(lags[best + 1])
    found = minimize_scalar(
        lambda lag: -np.nan_to_num(search.fit(float(lag)), nan=-1.0),
        bounds=(low, high),
        method="bounded",
        options={"xatol": 1e-4},
    )
    return float(found.x)


def _without_baseline(time_s: FloatArray, volume_l: FloatArray, *, is_flow: bool) -> FloatArray:
    """Subtract the baseline through the ends of exhale (asymmetric least squares) [l], shape (n,)."""
    if not is_flow:
        return volume_l
    pieces = max(1, round(float(time_s[-1] - time_s[0]) / PIECE_S))
    knots = np.linspace(time_s[0], time_s[-1], pieces + 1)
    hats = np.column_stack([np.interp(time_s, knots, row) for row in np.eye(len(knots))])
    weights = np.ones(len(time_s))
    line = np.zeros(len(time_s))
    for _ in range(_ROUNDS):
        scaled = hats * weights[:, None]
        line = hats @ np.linalg.lstsq(hats.T @ scaled, scaled.T @ volume_l, rcond=None)[0]
        before, weights = weights, np.where(volume_l > line, _BELOW, 1.0 - _BELOW)
        if np.array_equal(before, weights):
            break
    return np.asarray(volume_l - line)


def _comparison(
    lag_s: float,
    lags: FloatArray,
    fits: FloatArray,
    inside: BoolArray,
    tidegate: FloatArray,
    spirometer: FloatArray,
    overlap_s: float,
) -> SpirometerComparison:
    found = correlation(tidegate, spirometer)
    if found is None:
        raise InvalidValueError("volume", "constant", "a volume that changes: there is no breath in it")
    scale, offset = np.polyfit(spirometer, tidegate, 1)
    error = np.abs(tidegate - offset - scale * spirometer)
    low, high = np.percentile(tidegate, [5.0, 95.0])
    percent = 100.0 * error / max(float(high - low), 1e-12)
    rival = _rival(lag_s, lags, fits)
    full = [np.full(len(inside), np.nan) for _ in range(2)]
    full[0][inside], full[1][inside] = tidegate, spirometer
    return SpirometerComparison(
        lag_s=lag_s,
        correlation=found,
        scale=float(scale),
        error_percent=float(percent.mean()),
        error_deviation_percent=float(percent.std()),
        overlap_s=overlap_s,
        tidegate_l=full[0],
        spirometer_l=full[1],
        rival_lag_s=rival,
        notices=_notices(fits, rival),
    )


def _rival(lag_s: float, lags: FloatArray, fits: FloatArray) -> float | None:
    """Return the highest other peak if it is nearly as high as the best one."""
    inner = np.arange(1, len(lags) - 1)
    with np.errstate(invalid="ignore"):
        is_peak = (fits[inner] >= fits[inner - 1]) & (fits[inner] >= fits[inner + 1])
        is_peak &= (np.abs(lags[inner] - lag_s) > RIVAL_AWAY_S) & (
            1.0 - fits[inner] < RIVAL_RATIO * (1.0 - np.nanmax(fits))
        )
    peaks = inner[is_peak]
    return float(lags[peaks[np.argmax(fits[peaks])]]) if peaks.size else None


def _notices(fits: FloatArray, rival_lag_s: float | None) -> list[str]:
    if -np.nanmin(fits) > np.nanmax(fits) + UPSIDE_MARGIN:
        return ["the volumes fit better with the sign reversed: is this spirometer's sign positive for exhaled air?"]
    if rival_lag_s is not None:
        return [
            f"a lag of {rival_lag_s:.2f} s fits nearly as well: the breathing is too regular or the recording too "
            "short; let the volunteer sigh once, or start both instruments together"
        ]
    return []
