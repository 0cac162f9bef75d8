"""The latency from a light's changes: each bounds it from both sides, and most of them must agree.

A picture with light shows that its exposure's middle was after the change, the picture before it that its own was
before. Each change so bounds the latency to one frame period and to what is unknown of the change itself. The changes
fall at every phase of the frame period, so that all bounds together are much narrower.

Changes on and off are judged apart: exposure, saturation and the output's own delay act on them in opposite ways. The
estimate covers both, so that their difference is a part of its uncertainty.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from engine.core.bounds import check_number
from engine.core.frames import BoolArray, FloatArray
from engine.qa.latency.captured import CameraLatency, FrameTimes, Pictures, camera_latency, fit_host_times
from engine.qa.latency.light_driver import LightChange, level_at, refuse_pattern

MIN_CORRELATION = 0.75
MAX_OTHER_SHARE = 0.75
"""Highest correlation at another delay, as a share of the best."""
DELAY_STEP_MS = 5.0
SOUGHT_MS = (-200.0, 1200.0)
"""Range of the delays compared: beyond that of a camera, so that an impossible one is found and refused."""
SLOW_S = 3.0
"""Slower changes of the brightness are taken out before the search, as those of daylight."""
FAINTEST = 2.0
"""Least step of a block's brightness, of 255."""
BRIGHT = 245.0
SETTLED = 0.25
MAX_UNSETTLED_SHARE = 0.03
NOT_IN_VIEW = (
    "no part of the picture follows the light: it is not in view, not connected, always on or off, or too faint beside "
    "what flickers in the room"
)
NS_PER_MS = 1e6
FEWEST_FRAMES = 300
MAX_MISSED_SHARE = 0.1
MIN_AGREEING_SHARE = 0.9
MAX_WIDTH_MS = 50.0
STAMP_MS = 1.0
"""Error of a device time and of the line through them, by which each bound is widened [ms]."""
OUTPUT_BOUNDS_MS = (0.0, 50.0)


# The light in the pictures: where it is, and whether it is on in each.
#
# Neither its place nor the latency is known: the block and the delay are sought at which brightness and pattern agree
# best. A clear reason is returned, and never a delay, where no block follows the pattern, where two delays fit, or
# where the brightness changes although the light does not.
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LightSeen:
    """The light in each picture.

    Attributes
    ----------
    is_on
        Whether more than half of the light's step is seen, shape (n,).
    delay_ms
        Delay of the best agreement, to some milliseconds.
    place
        Row and column of its block.
    step
        The step of the block's brightness, of 255.
    partial_share
        Share of the changes with a picture in between: about the exposure's share of the frame period.
    """

    is_on: BoolArray
    delay_ms: float
    place: tuple[int, int]
    step: float
    partial_share: float


def see_light(
    pictures: Pictures, host_ns: FloatArray, changes: Sequence[LightChange], period_ms: float
) -> LightSeen | str:
    """Find the light and decide on each picture.

    Parameters
    ----------
    host_ns
        When each picture's promptest frame is received [ns, host], shape (n,).
    """
    rows, columns = pictures.blocks.shape[1:]
    blocks = pictures.blocks.reshape(len(host_ns), rows * columns)
    delays_ms = np.arange(SOUGHT_MS[0], SOUGHT_MS[1] + 0.5 * DELAY_STEP_MS, DELAY_STEP_MS)
    expected = np.array([level_at(changes, host_ns - delay * NS_PER_MS) for delay in delays_ms])
    span = max(round(1000.0 * SLOW_S / period_ms), 3)
    likeness = _correlation(_without_slow(expected.T, span).T, _without_slow(blocks, span))
    delay, block = np.unravel_index(int(np.argmax(likeness)), likeness.shape)
    best = float(likeness[delay, block])
    if best < MIN_CORRELATION:
        return _why_unseen(blocks)
    far = np.abs(delays_ms - delays_ms[delay]) > 2.0 * period_ms + DELAY_STEP_MS
    other = float(likeness[far, block].max())
    if other > MAX_OTHER_SHARE * best:
        return f"the pictures agree with the pattern at two delays (correlations {best:.2f} and {other:.2f})"
    return _decide(
        blocks[:, block],
        expected[delay],
        _is_settled(changes, host_ns - delays_ms[delay] * NS_PER_MS, period_ms),
        delay_ms=float(delays_ms[delay]),
        place=(int(block) // columns, int(block) % columns),
        count=len(changes),
    )


def _decide(
    brightness: FloatArray,
    expected: FloatArray,
    settled: BoolArray,
    *,
    delay_ms: float,
    place: tuple[int, int],
    count: int,
) -> LightSeen | str:
    is_lit, is_dark = settled & (expected > 0.5), settled & (expected < 0.5)
    if not is_lit.any() or not is_dark.any():
        return "the light never stood still for two frames"
    dark, lit = float(np.median(brightness[is_dark])), float(np.median(brightness[is_lit]))
    step = lit - dark
    if step < FAINTEST:
        return NOT_IN_VIEW
    share = (brightness - dark) / step
    unsettled = float(np.mean(np.abs(share - expected)[settled] > SETTLED))
    if unsettled > MAX_UNSETTLED_SHARE:
        return (
            f"the brightness at the light changes though the light does not, in {100 * unsettled:.0f} % of the "
            "pictures: the room light flickers, the exposure is automatic, something moves there, or the light is faint"
        )
    is_partial = (share > SETTLED) & (share < 1.0 - SETTLED)
    return LightSeen(
        is_on=share > 0.5,
        delay_ms=delay_ms,
        place=place,
        step=step,
        partial_share=min(float(is_partial.sum()) / (1.0 - 2.0 * SETTLED) / count, 1.0),
    )


def _is_settled(changes: Sequence[LightChange], light_ns: FloatArray, period_ms: float) -> BoolArray:
    """Whether each picture is at least one and a half frames away from every change."""
    middle_ns = np.array([0.5 * (change.earliest_ns + change.latest_ns) for change in changes])
    after = np.clip(np.searchsorted(middle_ns, light_ns), 1, len(middle_ns) - 1)
    nearest = np.minimum(np.abs(light_ns - middle_ns[after - 1]), np.abs(middle_ns[after] - light_ns))
    known_ns = max(change.latest_ns - change.earliest_ns for change in changes)
    found: BoolArray = nearest > 1.5 * period_ms * NS_PER_MS + 0.5 * known_ns
    return found


def _why_unseen(blocks: FloatArray) -> str:
    brightest = float(np.median(blocks, axis=0).max())
    if brightest >= BRIGHT:
        return (
            f"{NOT_IN_VIEW}; a part of the picture is saturated ({brightest:.0f} of 255), where a light cannot be seen"
        )
    return NOT_IN_VIEW


def _without_slow(values: FloatArray, span: int) -> FloatArray:
    """Subtract the moving mean over ``span`` rows from each column, shape (n, m)."""
    padded = np.pad(values, ((span // 2 + 1, span - span // 2 - 1), (0, 0)), mode="edge")
    sums = np.cumsum(padded, axis=0, dtype=np.float64)
    mean: npt.NDArray[np.float64] = (sums[span:] - sums[:-span]) / span
    return values - mean[: len(values)]


def _correlation(expected: FloatArray, seen: FloatArray) -> FloatArray:
    """Correlate each row of ``expected`` (k, n) with each column of ``seen`` (n, m); 0 where one is constant."""
    seen_norm = np.linalg.norm(seen, axis=0)
    expected_norm = np.linalg.norm(expected, axis=1)
    least = np.outer(np.maximum(expected_norm, 1e-9), np.maximum(seen_norm, 1e-3))
    found: FloatArray = (expected @ seen) / least
    return found


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
