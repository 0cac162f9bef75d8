"""Phase lag between two regions: thorax and abdomen, or a named region and the whole.

Over the last three cycles, at most 20 s, the correlation of the two signals is computed for every shift of up to half a
cycle; its peak, refined by a parabola, is the lag. Pearson's correlation over the overlap is used at each shift, so
signals of equal shape have a peak of 1 at their true lag even with few cycles. An isovolume manoeuvre is a lag of half
a cycle. Without motion, periodicity or agreement there is a reason instead of a lag.

The functions are pure: state goes in and comes out. Frames are averaged over bins of 0.1 s.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from engine.core.compiled import FramePath
from engine.core.frames import FloatArray, PhaseLag, frozen
from engine.core.replacing import replace

BIN_S = 0.1
WINDOW_S = 20.0
CYCLES = 3.0
MIN_CYCLES = 2.0
ENOUGH_S = 12.0  # two cycles of slow breathing: with less data the lag may still be found later
MAX_GAP_S = 1.0
MIN_PERIOD_S = 1.0
MIN_EXCURSION_MM = 0.8
MIN_REGULARITY = 0.5
MIN_CONFIDENCE = 0.7
FIRST_PEAK_SHARE = 0.85  # the correlation at two cycles is as high as at one
LEAST_VARIANCE = 1e-12
"""Product of two signals' sums of squares below which they have no correlation."""
EVERY_BINS = 4
MIN_PAIRS = 3
"""One pair is evaluated every fourth bin: with three pairs each about once a second, and never two in one frame."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LagState:
    """State between frames.

    Attributes
    ----------
    pairs
        Compared signals: name and position of the first, then of the second.
    seconds, signals_mm
        Closed bins: mean time [s], shape (n,), and mean signals [mm], shape (n, signals).
    open_from_s, open_seconds, open_signals_mm, open_frames
        Start of the open bin, and sums over its frames.
    turn
        Number of closed bins.
    lags
        Latest result of each pair.
    """

    pairs: tuple[tuple[str, int, str, int], ...]
    seconds: FloatArray
    signals_mm: FloatArray
    open_from_s: float = 0.0
    open_seconds: float = 0.0
    open_signals_mm: FloatArray | None = None
    open_frames: int = 0
    turn: int = 0
    lags: tuple[PhaseLag, ...]


def start_lags(pairs: tuple[tuple[str, int, str, int], ...], signals: int) -> LagState:
    """Return the initial state for pairs among ``signals`` signals."""
    lags = tuple(_no_lag(first, second, "nothing seen yet") for first, _, second, _ in pairs)
    return LagState(pairs=pairs, seconds=frozen(np.empty(0)), signals_mm=frozen(np.empty((0, signals))), lags=lags)


def follow_lags(state: LagState, seconds: float, signals_mm: FloatArray) -> LagState:
    """Add a frame's signals.

    Parameters
    ----------
    seconds
        Device time of the frame [s].
    signals_mm
        Motion of the regions [mm] with any offset, inhale positive, shape (signals,).
    """
    open_mm = state.open_signals_mm
    if open_mm is None or not 0.0 < seconds - state.open_from_s < MAX_GAP_S:
        state = state if open_mm is None else start_lags(state.pairs, state.signals_mm.shape[1])
        return replace(state, open_from_s=seconds, open_seconds=seconds, open_signals_mm=signals_mm, open_frames=1)
    if seconds - state.open_from_s >= BIN_S:
        state = _close_bin(state)
        return replace(state, open_from_s=seconds, open_seconds=seconds, open_signals_mm=signals_mm, open_frames=1)
    return replace(
        state,
        open_seconds=state.open_seconds + seconds,
        open_signals_mm=open_mm + signals_mm,
        open_frames=state.open_frames + 1,
    )


def _close_bin(state: LagState) -> LagState:
    mean_s = state.open_seconds / state.open_frames
    first = int(np.searchsorted(state.seconds, mean_s - WINDOW_S))
    seconds = np.concatenate([state.seconds[first:], (mean_s,)])
    signals_mm = np.concatenate([state.signals_mm[first:], np.array(state.open_signals_mm)[None] / state.open_frames])
    lags = list(state.lags)
    round_bins = EVERY_BINS * max(len(state.pairs), MIN_PAIRS)
    position, rest = divmod(state.turn % round_bins, EVERY_BINS)
    if rest == 0 and position < len(state.pairs):
        name, first_at, other, second_at = state.pairs[position]
        lags[position] = find_lag(seconds, signals_mm[:, first_at], signals_mm[:, second_at], first=name, second=other)
    return replace(state, seconds=frozen(seconds), signals_mm=frozen(signals_mm), turn=state.turn + 1, lags=tuple(lags))


def find_lag(seconds: FloatArray, first_mm: FloatArray, second_mm: FloatArray, *, first: str, second: str) -> PhaseLag:
    """Compute the lag of ``first`` behind ``second`` at the end of two signals.

    Parameters
    ----------
    seconds, first_mm, second_mm
        Times [s], ascending, and signals [mm] of any offset, each of shape (n,); with a NaN there is no lag.
    """
    if len(seconds) < 3 or seconds[-1] - seconds[0] < MIN_CYCLES * MIN_PERIOD_S:
        return _no_lag(first, second, "too little seen yet")
    a, b = (_evenly(seconds, signal) for signal in (first_mm, second_mm))
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return _no_lag(first, second, "a region is not measured")
    for name, signal in ((first, a), (second, b)):
        if _excursion_mm(signal) < MIN_EXCURSION_MM:
            return _no_lag(first, second, f"{name} moves by less than {MIN_EXCURSION_MM:g} mm")
    period, regularity = _period(_without_line(a), _without_line(b))
    if period is None or regularity < MIN_REGULARITY:
        is_early = seconds[-1] - seconds[0] < ENOUGH_S
        return _no_lag(first, second, "too little seen yet" if is_early else "no regular breathing")
    period_s = period * BIN_S
    count = min(len(a), round(CYCLES * period) + 1)
    a, b = (_without_drift(signal, period)[-count:] for signal in (a, b))
    shift, confidence = _best_shift(a, b, 0.5 * period)
    if confidence < MIN_CONFIDENCE:
        note = "the two do not move alike"
        return PhaseLag(first=first, second=second, period_s=period_s, confidence=confidence, note=note)
    share = shift / period
    share -= np.ceil(share - 0.5)  # above -1/2, up to 1/2
    return PhaseLag(
        first=first,
        second=second,
        lag_s=float(share * period_s),
        lag_deg=float(360.0 * share),
        period_s=period_s,
        confidence=confidence,
    )


def _no_lag(first: str, second: str, note: str) -> PhaseLag:
    return PhaseLag(first=first, second=second, note=note)


def _excursion_mm(signal_mm: FloatArray) -> float:
    """Approximate range from the 5th to the 95th percentile [mm]; ten times as fast as `np.percentile`."""
    ordered = np.sort(signal_mm)
    margin = len(ordered) // 20
    return float(ordered[len(ordered) - 1 - margin] - ordered[margin])


def _evenly(seconds: FloatArray, signal_mm: FloatArray) -> FloatArray:
    """Resample at steps of `BIN_S` back from the newest sample, and subtract the mean."""
    even = np.interp(seconds[-1] - _steps_back_s(int((seconds[-1] - seconds[0]) / BIN_S) + 1), seconds, signal_mm)
    return np.asarray(even - even.mean())


@lru_cache(maxsize=4)
def _steps_back_s(count: int) -> FloatArray:
    """Return the steps back from the newest of so many samples [s]."""
    return frozen(BIN_S * np.arange(count - 1, -1, -1))


def _without_line(signal: FloatArray) -> FloatArray:
    """Subtract the best-fitting slope from a signal of mean zero."""
    place, square = _line(len(signal))
    return np.asarray(signal - place * (place @ signal) / square)


@lru_cache(maxsize=4)
def _line(size: int) -> tuple[FloatArray, float]:
    """Return a slope over so many samples, from -1 to 1, and its square."""
    place = np.linspace(-1.0, 1.0, size)
    return frozen(place), float(place @ place)


def _without_drift(signal: FloatArray, period: float) -> FloatArray:
    """Subtract the drift from cycle to cycle; a fitted line would depend on the phase of the cycle."""
    cycle = round(period)
    drift = (signal[cycle:] - signal[:-cycle]).mean() / cycle
    return np.asarray(signal - drift * np.arange(len(signal)))


def _period(a: FloatArray, b: FloatArray) -> tuple[float | None, float]:
    """Return the length of a cycle [bins], and the autocorrelation at that lag, 0 to 1."""
    longest = int(len(a) / MIN_CYCLES)
    agreement = 0.5 * (_correlations(a, a) + _correlations(b, b))[len(a) - 1 : len(a) + longest + 1]
    fallen = np.flatnonzero(agreement < 0.0)
    if fallen.size == 0:
        return None, 0.0
    start = max(int(fallen[0]), round(MIN_PERIOD_S / BIN_S))
    later = agreement[start:]
    is_high = (later[1:-1] >= later[:-2]) & (later[1:-1] >= later[2:])
    is_high &= later[1:-1] >= FIRST_PEAK_SHARE * later.max(initial=0.0)
    if not is_high.any():
        return None, 0.0
    near = start + 1 + int(np.argmax(is_high))
    reach = max(near // 4, 1)  # noise may cause a local maximum before the true one
    peak = near - reach + int(np.argmax(agreement[near - reach : min(near + reach + 1, len(agreement) - 1)]))
    return peak + _summit(agreement[peak - 1 : peak + 2]), float(agreement[peak])


def _best_shift(a: FloatArray, b: FloatArray, reach: float) -> tuple[float, float]:
    """Return the shift of ``a`` behind ``b`` [bins], and their correlation at it."""
    center, span = len(a) - 1, min(int(np.ceil(reach)) + 1, len(a) - 3)
    agreement = _correlations(a, b)[center - span : center + span + 1]
    peak = 1 + int(np.argmax(agreement[1:-1]))
    around = agreement[peak - 1 : peak + 2]
    step = _summit(around) if around[1] >= max(around[0], around[2]) else 0.0
    return peak - span + step, float(min(agreement[peak], 1.0))


def _summit(around: FloatArray) -> float:
    """Vertex of the parabola through three values at -1, 0 and 1, of which the middle one is the largest."""
    before, middle, after = around.tolist()
    bend = before - 2.0 * middle + after
    return 0.5 * (before - after) / bend if bend < 0.0 else 0.0


def _correlations(a: FloatArray, b: FloatArray) -> FloatArray:
    """Pearson's correlation of ``a`` shifted by -(n - 1) to n - 1 with ``b``, over the overlap, shape (2n - 1,)."""
    compiled = FramePath.kernels
    if compiled is None:
        return _correlate(a, b)
    correlations = np.empty(2 * len(a) - 1)
    compiled.shift_correlations(np.ascontiguousarray(a), np.ascontiguousarray(b), LEAST_VARIANCE, correlations)
    return correlations


def _correlate(a: FloatArray, b: FloatArray) -> FloatArray:
    """Correlate with numpy."""
    size = len(a)
    overlap = np.concatenate([np.arange(1, size + 1), np.arange(size - 1, 0, -1)])
    sum_a, sum_aa = _overlap_sums(a)
    sum_b, sum_bb = (sums[::-1] for sums in _overlap_sums(b))
    covariance = np.correlate(a, b, "full") - sum_a * sum_b / overlap
    variances = (sum_aa - sum_a**2 / overlap) * (sum_bb - sum_b**2 / overlap)
    is_known = variances > LEAST_VARIANCE
    return np.asarray(np.where(is_known, covariance / np.sqrt(np.maximum(variances, LEAST_VARIANCE)), 0.0))


def _overlap_sums(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sum the first 1 to n values, then the last n - 1 to 1, shape (2n - 1,); and their squares."""
    sums = []
    for terms in (values, values * values):
        running = np.cumsum(terms)
        sums.append(np.concatenate([running, running[-1] - running[:-1]]))
    return sums[0], sums[1]
