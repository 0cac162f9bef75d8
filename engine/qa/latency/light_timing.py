"""The latency from a light's changes: each bounds it from both sides, and most of them must agree.

A picture with light shows that its exposure's middle was after the change, the picture before it that its own was
before. Each change so bounds the latency to one frame period and to what is unknown of the change itself. The changes
fall at every phase of the frame period, so that all bounds together are much narrower.

Changes on and off are judged apart: exposure, saturation and the output's own delay act on them in opposite ways. The
estimate covers both, so that their difference is a part of its uncertainty.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from engine.core.bounds import check_number
from engine.core.frames import BoolArray, FloatArray
from engine.qa.latency.captured import FrameTimes, Pictures
from engine.qa.latency.host_times import fit_host_times
from engine.qa.latency.light_pattern import LightChange, refuse_pattern
from engine.qa.latency.light_signal import LightSeen, see_light
from engine.qa.latency.results import CameraLatency, camera_latency

NS_PER_MS = 1e6
FEWEST_FRAMES = 300
MAX_MISSED_SHARE = 0.1
MIN_AGREEING_SHARE = 0.9
MAX_WIDTH_MS = 50.0
STAMP_MS = 1.0
"""Error of a device time and of the line through them, by which each bound is widened [ms]."""
OUTPUT_BOUNDS_MS = (0.0, 50.0)


def latency_by_light(
    times: FrameTimes, pictures: Pictures, changes: Sequence[LightChange], *, output_ms: float
) -> CameraLatency | str:
    """Estimate the latency; return the reason, a sentence, where it cannot be estimated.

    Parameters
    ----------
    output_ms
        Longest time from the output's read-back to the light, as a bound [ms].
    """
    check_number("output_delay_ms", output_ms, *OUTPUT_BOUNDS_MS)
    why = refuse_frames(times) or refuse_pattern(changes)
    if why is not None:
        return why
    host = fit_host_times(times.device_us, times.received_ns)
    if isinstance(host, str):
        return host
    host_ns = host.of(pictures.device_us)
    seen = see_light(pictures, host_ns, changes, times.period_ms)
    if isinstance(seen, str):
        return seen
    agreed: list[tuple[float, float]] = []
    for is_on in (True, False):
        found = _agreed(_bounds_ms(host_ns, seen, changes, is_on=is_on, output_ms=output_ms))
        if isinstance(found, str):
            return f"the light going {'on' if is_on else 'off'}: {found}"
        agreed.append(found)
    low_ms = min(low for low, _ in agreed)
    high_ms = max(high for _, high in agreed)
    if high_ms - low_ms > MAX_WIDTH_MS:
        return (
            f"the latency is known to {high_ms - low_ms:.0f} ms only, {MAX_WIDTH_MS:g} are allowed: the output or the "
            "light is slow, or the light is so bright that it saturates the picture"
        )
    detail = (
        f"{len(changes)} changes of the light, step {seen.step:.0f} of 255, exposure about "
        f"{seen.partial_share * times.period_ms:.0f} ms, clocks differ by {host.rate_error_ppm:.0f} ppm"
    )
    return camera_latency(times, host, low_ms=low_ms, high_ms=high_ms, detail=detail)


def refuse_frames(times: FrameTimes) -> str | None:
    """Return why the frames cannot be used; None where they can."""
    if len(times.device_us) < FEWEST_FRAMES:
        return f"{len(times.device_us)} frames came: at least {FEWEST_FRAMES} are needed"
    if times.missed_share > MAX_MISSED_SHARE:
        return (
            f"the camera lost {100 * times.missed_share:.0f} % of its frames: at most {100 * MAX_MISSED_SHARE:.0f} % "
            "are allowed"
        )
    return None


def _bounds_ms(
    host_ns: FloatArray,
    seen: LightSeen,
    changes: Sequence[LightChange],
    *,
    is_on: bool,
    output_ms: float,
) -> FloatArray:
    """Return lowest and highest latency [ms] by each change of one direction, shape (n, 2); NaN where none was seen."""
    flips = np.flatnonzero((seen.is_on[1:] == is_on) & (seen.is_on[:-1] != is_on))
    chosen = [change for change in changes if change.is_on is is_on]
    earliest, latest = np.array([(change.earliest_ns, change.latest_ns) for change in chosen], dtype=np.float64).T
    if not len(flips):
        return np.full((len(chosen), 2), np.nan)
    middle_ns = 0.5 * (host_ns[flips] + host_ns[flips + 1]) - seen.delay_ms * NS_PER_MS
    nearest = flips[np.argmin(np.abs(middle_ns[None, :] - 0.5 * (earliest + latest)[:, None]), axis=1)]
    low_ms = (host_ns[nearest] - latest) / NS_PER_MS - output_ms - STAMP_MS
    high_ms = (host_ns[nearest + 1] - earliest) / NS_PER_MS + STAMP_MS
    return np.column_stack([low_ms, high_ms])


def _agreed(bounds_ms: npt.NDArray[np.floating]) -> tuple[float, float] | str:
    """Return the latencies [ms] that `MIN_AGREEING_SHARE` of the bounds permit; the reason where there is none."""
    edges = np.unique(bounds_ms)
    edges = edges[np.isfinite(edges)]
    if len(edges) < 2:
        return "no change was seen"
    middles = 0.5 * (edges[1:] + edges[:-1])
    votes = np.sum(_holds(bounds_ms, middles), axis=1)
    share = float(votes.max()) / len(bounds_ms)
    if share < MIN_AGREEING_SHARE:
        return (
            f"{100 * share:.0f} % of the changes agree on a latency, {100 * MIN_AGREEING_SHARE:.0f} % are needed: "
            "something else changes at the light, or the output's delay is longer than stated"
        )
    agreed = np.flatnonzero(votes >= MIN_AGREEING_SHARE * len(bounds_ms))
    return float(edges[agreed[0]]), float(edges[agreed[-1] + 1])


def _holds(bounds_ms: FloatArray, at_ms: FloatArray) -> BoolArray:
    held: BoolArray = (bounds_ms[:, 0] <= at_ms[:, None]) & (at_ms[:, None] <= bounds_ms[:, 1])
    return held
