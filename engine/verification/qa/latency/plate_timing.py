"""The latency from a plate that moves along a trace whose times are known on this machine's clock.

The delay is sought at which the plate's distance follows the trace best. It has to follow it nearly exactly, mm for
mm, and no other delay may fit nearly as well: a regular motion faster than a second, or one that the plate did not
make, gives no number.
"""

import numpy as np
import numpy.typing as npt

from engine.core.bounds import check_number
from engine.core.frames import FloatArray
from engine.verification.qa.latency.captured import FrameTimes
from engine.verification.qa.latency.host_times import fit_host_times
from engine.verification.qa.latency.light_timing import refuse_frames
from engine.verification.qa.latency.results import CameraLatency, camera_latency
from engine.verification.qa.trace import CommandedTrace

S_PER_MS = 1e-3
NS_PER_S = 1e9
SOUGHT_MS = (-200.0, 1200.0)
STEP_MS = 5.0
MIN_REACH_MM = 3.0
MIN_CORRELATION = 0.98
MAX_OTHER = 0.9
"""Highest correlation at another delay at which the plate follows the trace better than just before and after."""
SCALE_BOUNDS = (0.85, 1.15)
MAX_UNREAD_SHARE = 0.05
PARTS = 6
SIGMAS = 3.0
CLOCK_BOUNDS_MS = (0.1, 20.0)
MAX_WIDTH_MS = 50.0


def latency_by_plate(
    times: FrameTimes, distance_mm: FloatArray, trace: CommandedTrace, *, zero_ns: int, clock_ms: float
) -> CameraLatency | str:
    """Estimate the latency; return the reason, a sentence, where it cannot be estimated.

    Parameters
    ----------
    distance_mm
        Distance of the plate in each frame [mm], shape (n,); NaN without a reading.
    trace
        Position of the plate, positive towards the camera, against time [s] since ``zero_ns``.
    zero_ns
        Host monotonic time of the trace's time 0 [ns].
    clock_ms
        Bound of the error of the trace's times against this machine's clock, the controller's delay included [ms].
    """
    check_number("clock_error_ms", clock_ms, *CLOCK_BOUNDS_MS)
    host = fit_host_times(times.device_us, times.received_ns) if (why := refuse_frames(times)) is None else why
    if isinstance(host, str):
        return host
    at_s = (host.of(times.device_us) - zero_ns) / NS_PER_S
    chosen = _usable(at_s, distance_mm, trace)
    if isinstance(chosen, str):
        return chosen
    at_s, height_mm = at_s[chosen], -distance_mm[chosen]
    delay_ms = _delay_ms(at_s, height_mm, trace)
    if isinstance(delay_ms, str):
        return delay_ms
    half_ms = clock_ms + _scatter_ms(at_s, height_mm, trace, delay_ms)
    if 2.0 * half_ms > MAX_WIDTH_MS:
        return f"the latency is known to {2.0 * half_ms:.0f} ms only, {MAX_WIDTH_MS:g} are allowed: move faster"
    detail = f"{len(at_s)} frames of a plate, clocks differ by {host.rate_error_ppm:.0f} ppm"
    return camera_latency(times, host, low_ms=delay_ms - half_ms, high_ms=delay_ms + half_ms, detail=detail)


def _usable(at_s: FloatArray, distance_mm: FloatArray, trace: CommandedTrace) -> npt.NDArray[np.bool_] | str:
    """Return which frames have a reading and lie within the trace at every delay; the reason where too few do."""
    first_s, last_s = trace.span_s
    early_s, late_s = (S_PER_MS * edge for edge in SOUGHT_MS)
    within = (at_s > first_s + late_s) & (at_s < last_s + early_s)
    if within.sum() < 0.5 * len(at_s):
        return "the trace covers less than half of the frames: do its times belong to this run?"
    if float(np.mean(~np.isfinite(distance_mm[within]))) > MAX_UNREAD_SHARE:
        return "the middle of the picture has no reading: the plate is not in view"
    found: npt.NDArray[np.bool_] = within & np.isfinite(distance_mm)
    if float(np.ptp(trace.at(at_s[found]))) < MIN_REACH_MM:
        return f"the trace moves by less than {MIN_REACH_MM:g} mm while it is seen"
    return found


def _delay_ms(at_s: FloatArray, height_mm: FloatArray, trace: CommandedTrace) -> float | str:
    coarse = np.arange(SOUGHT_MS[0], SOUGHT_MS[1] + 0.5 * STEP_MS, STEP_MS)
    likeness = np.array([_likeness(delay, at_s, height_mm, trace) for delay in coarse.tolist()])
    best = int(np.argmax(likeness))
    if likeness[best] < MIN_CORRELATION:
        return (
            f"the plate does not follow the trace (correlation {likeness[best]:.2f}, {MIN_CORRELATION:g} is needed): "
            "another motion, another sign, or times of another clock"
        )
    is_peak = np.r_[False, (likeness[1:-1] > likeness[:-2]) & (likeness[1:-1] > likeness[2:]), False]
    if (
        best in {0, len(coarse) - 1}
        or float(np.max(likeness, initial=0.0, where=is_peak & (coarse != coarse[best]))) > MAX_OTHER
    ):
        return "the plate follows the trace at more than one delay: its motion repeats itself within a second"
    span = (float(coarse[best]) - STEP_MS, float(coarse[best]) + STEP_MS)
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(lambda delay: -_likeness(delay, at_s, height_mm, trace), bounds=span, method="bounded")
    scale = float(np.polyfit(trace.at(at_s - S_PER_MS * found.x), height_mm, 1)[0])
    if not SCALE_BOUNDS[0] <= scale <= SCALE_BOUNDS[1]:
        low, high = SCALE_BOUNDS
        return f"the plate moves {scale:.2f} mm for each mm of the trace: must be {low:g} to {high:g}"
    return float(found.x)


def _likeness(delay_ms: float, at_s: FloatArray, height_mm: FloatArray, trace: CommandedTrace) -> float:
    expected = trace.at(at_s - S_PER_MS * delay_ms)
    if np.ptp(expected) == 0.0 or np.ptp(height_mm) == 0.0:
        return 0.0
    return float(np.corrcoef(expected, height_mm)[0, 1])


def _scatter_ms(at_s: FloatArray, height_mm: FloatArray, trace: CommandedTrace, delay_ms: float) -> float:
    """Three standard errors of the delay, from its scatter between parts of the run [ms]."""
    found = []
    for at, height in zip(np.array_split(at_s, PARTS), np.array_split(height_mm, PARTS), strict=True):
        around = delay_ms + np.arange(-40.0, 41.0, 1.0)
        likeness = [_likeness(delay, at, height, trace) for delay in around.tolist()]
        found.append(float(around[int(np.argmax(likeness))]))
    return SIGMAS * float(np.std(found, ddof=1)) / float(np.sqrt(PARTS)) + 0.5
