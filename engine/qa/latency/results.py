"""The estimated latency of a camera."""

from dataclasses import dataclass

import numpy as np

from engine.core.frames import FloatArray
from engine.qa.latency.captured import FrameTimes
from engine.qa.latency.host_times import HostTimes

NS_PER_MS = 1e6
LONGEST_MS = 1000.0
SHORTEST_MS = -5.0
"""Least latency that is not refused as impossible [ms]; an estimate near 0 may be negative by its uncertainty."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraLatency:
    """Latency from light to the receipt of the depth frame [ms].

    Attributes
    ----------
    prompt_ms
        Of the promptest frame: the part that no time stamp shows.
    latencies_ms
        Of each frame: that, and how much later than the promptest it was received; shape (n,).
    uncertainty_ms
        Half the width of the interval that holds ``prompt_ms``.
    detail
        How many changes or samples agreed, for the report.
    """

    prompt_ms: float
    latencies_ms: FloatArray
    uncertainty_ms: float
    detail: str

    @property
    def median_ms(self) -> float:
        """Median over all frames."""
        return float(np.median(self.latencies_ms))

    @property
    def p95_ms(self) -> float:
        """95th percentile."""
        return float(np.percentile(self.latencies_ms, 95.0))

    @property
    def worst_ms(self) -> float:
        """Of the slowest frame."""
        return float(self.latencies_ms.max())


def camera_latency(
    times: FrameTimes, host: HostTimes, *, low_ms: float, high_ms: float, detail: str
) -> CameraLatency | str:
    """Return the latency whose prompt part lies between two bounds; the reason where it is impossible."""
    prompt_ms = 0.5 * (low_ms + high_ms)
    if not SHORTEST_MS <= prompt_ms <= LONGEST_MS:
        return (
            f"the frames seem to be received {prompt_ms:.0f} ms after their light: must be 0 to {LONGEST_MS:g} ms, "
            "so that the times of the change are wrong"
        )
    late_ms = (times.received_ns - host.of(times.device_us)) / NS_PER_MS
    return CameraLatency(
        prompt_ms=prompt_ms,
        latencies_ms=prompt_ms + np.maximum(late_ms, 0.0),
        uncertainty_ms=0.5 * (high_ms - low_ms),
        detail=detail,
    )
