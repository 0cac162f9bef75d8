"""What the latency is estimated from: the times of the frames, and the brightness of each colour picture.

Device times on the host's clock, by the line below all lags of a stream's frames.

The lag of a frame, its receipt less its device time, is the delay of the promptest frame plus what delayed this one.
The line below all lags that is nearest to their sum is the promptest frame's, also where the two clocks differ in
rate: Moon, Skelly, Towsley, "Estimation and removal of clock skew from network delay measurements", INFOCOM 1999. It
passes through two lags, so that it is found among the edges of their lower convex hull.

The estimated latency of a camera.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.frames import FloatArray, RgbdFrame
from engine.gating.delivery import MAX_RATE_ERROR_PPM

Times = npt.NDArray[np.int64]
BLOCKS_ACROSS, BLOCKS_DOWN = 80, 60
NS_PER_US = 1000
MAX_STAMP_STEP_US = 1_000_000
FEWEST = 2
NS_PER_MS = 1e6
LONGEST_MS = 1000.0
SHORTEST_MS = -5.0
"""Least latency that is not refused as impossible [ms]; an estimate near 0 may be negative by its uncertainty."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameTimes:
    """Times of the depth frames: of the device [us] and of the receipt [ns, host], shape (n,); lost frames in all."""

    device_us: Times
    received_ns: Times
    missed_frames: int

    @property
    def period_ms(self) -> float:
        """Median time between two frames [ms]."""
        return float(np.median(np.diff(self.device_us))) / 1e3

    @property
    def missed_share(self) -> float:
        """Share of the frames that the camera did not deliver, 0 to 1."""
        return self.missed_frames / (self.missed_frames + len(self.device_us))


class TimeLog:
    """Collects the times of frames."""

    def __init__(self) -> None:
        self._rows: list[tuple[int, int]] = []
        self._missed = 0

    def add(self, frame: RgbdFrame) -> None:
        """Add one frame."""
        self._rows.append((frame.timestamp_us, frame.received_ns))
        self._missed += frame.missed_frames if len(self._rows) > 1 else 0

    @property
    def times(self) -> FrameTimes:
        """The times so far."""
        device_us, received_ns = np.array(self._rows, dtype=np.int64).reshape(-1, 2).T.copy()
        return FrameTimes(device_us=device_us, received_ns=received_ns, missed_frames=self._missed)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pictures:
    """Colour pictures as mean brightness of blocks.

    Attributes
    ----------
    device_us
        Device time of each colour picture [us], increasing, shape (n,).
    blocks
        Mean brightness of each block, 0 to 255, shape (n, rows, columns).
    """

    device_us: Times
    blocks: FloatArray


class PictureLog:
    """Collects colour pictures; one that comes with two depth frames counts once."""

    def __init__(self) -> None:
        self._times_us: list[int] = []
        self._blocks: list[FloatArray] = []

    def add(self, frame: RgbdFrame) -> None:
        """Add the colour picture of one frame."""
        if self._times_us and frame.color_timestamp_us <= self._times_us[-1]:
            return
        gray = cv2.cvtColor(np.asarray(frame.color), cv2.COLOR_RGB2GRAY).astype(np.float32)
        size = min(BLOCKS_ACROSS, gray.shape[1]), min(BLOCKS_DOWN, gray.shape[0])
        self._times_us.append(frame.color_timestamp_us)
        self._blocks.append(np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), dtype=np.float32))

    @property
    def pictures(self) -> Pictures:
        """The pictures so far."""
        return Pictures(device_us=np.array(self._times_us, dtype=np.int64), blocks=np.array(self._blocks))


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
