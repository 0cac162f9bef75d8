"""Device times on the host's clock, by the line below all lags of a stream's frames.

The lag of a frame, its receipt less its device time, is the delay of the promptest frame plus what delayed this one.
The line below all lags that is nearest to their sum is the promptest frame's, also where the two clocks differ in
rate: Moon, Skelly, Towsley, "Estimation and removal of clock skew from network delay measurements", INFOCOM 1999. It
passes through two lags, so that it is found among the edges of their lower convex hull.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from engine.core.frames import FloatArray
from engine.gating.clock_rate import MAX_RATE_ERROR_PPM

Times = npt.NDArray[np.int64]
NS_PER_US = 1000
MAX_STAMP_STEP_US = 1_000_000
FEWEST = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class HostTimes:
    """Maps device times [us] to when the promptest frame with that time is received [ns, host].

    Attributes
    ----------
    begins_us
        Device time of the first frame.
    begins_ns
        Its receipt, had it been the promptest.
    rate
        Host nanoseconds for each nanosecond of the device, near 1.
    """

    begins_us: int
    begins_ns: float
    rate: float

    def of(self, device_us: Times) -> FloatArray:
        """Return host times [ns], same shape, float64."""
        host_ns: FloatArray = self.begins_ns + self.rate * ((device_us - self.begins_us) * NS_PER_US)
        return host_ns

    @property
    def rate_error_ppm(self) -> float:
        """How much the two clocks differ in rate [ppm]."""
        return 1e6 * (self.rate - 1.0)


def fit_host_times(device_us: Times, received_ns: Times) -> HostTimes | str:
    """Fit the line below all lags; return the reason, a sentence, where the times cannot be used.

    Parameters
    ----------
    device_us, received_ns
        Device time [us] and receipt [ns, host] of each depth frame, shape (n,), n at least 2.
    """
    steps_us = np.diff(device_us)
    if len(device_us) < FEWEST or (steps_us <= 0).any() or (np.diff(received_ns) <= 0).any():
        return "the times of the frames do not increase"
    if steps_us.max() > MAX_STAMP_STEP_US:
        return f"no frame came for {steps_us.max() / 1e6:.1f} s"
    device_ns = (device_us - device_us[0]).astype(np.float64) * NS_PER_US
    lag_ns = (received_ns - received_ns[0]).astype(np.float64) - device_ns
    first, second = _edge_below(device_ns, lag_ns)
    slope = float((lag_ns[second] - lag_ns[first]) / (device_ns[second] - device_ns[first]))
    if abs(slope) * 1e6 > MAX_RATE_ERROR_PPM:
        return (
            f"the camera's clock differs from the host's by {1e6 * abs(slope):.0f} ppm, or its delay grows: "
            f"{MAX_RATE_ERROR_PPM:g} are allowed"
        )
    begins_ns = float(received_ns[0]) + float(lag_ns[first] - slope * device_ns[first])
    return HostTimes(begins_us=int(device_us[0]), begins_ns=begins_ns, rate=1.0 + slope)


def _edge_below(at: FloatArray, lag: FloatArray) -> tuple[int, int]:
    """Return the ends of the edge of the lower convex hull that spans the mean of ``at``."""
    hull: list[int] = []
    for index in range(len(at)):
        while len(hull) > 1 and _is_above(at, lag, hull[-2], hull[-1], index):
            hull.pop()
        hull.append(index)
    middle = float(at.mean())
    second = next(place for place in range(1, len(hull)) if at[hull[place]] >= middle)
    return hull[second - 1], hull[second]


def _is_above(at: FloatArray, lag: FloatArray, before: int, middle: int, after: int) -> bool:
    """Whether the middle point lies on or above the line from the one before to the one after."""
    rise = (lag[middle] - lag[before]) * (at[after] - at[before])
    return bool(rise >= (lag[after] - lag[before]) * (at[middle] - at[before]))
