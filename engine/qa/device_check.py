"""A camera looked at before it is used: rates, losses, clock, noise and drift of a still scene.

The scene is a flat surface that nothing moves on, such as the bare couch, in the middle of the picture. What only a
real camera can show is found here; `tidegate devices check` prints it, and its file is what to send with a report.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from engine.capture import SourceDescription
from engine.core.clock import NS_PER_US
from engine.core.frames import FloatArray, RgbdFrame

PART = 0.25
"""Share of the picture's width and height that is looked at, in its middle."""
SQUARES_PX = (1, 4, 8, 16)
LEAST_FRAMES = 90
SPAN_S = 10.0
US_PER_S = 1e6
Verdict = Literal["pass", "warn", "fail"]


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceFinding:
    """One figure of a camera; a bound of None is not judged."""

    code: str
    title: str
    value: float
    unit: str
    warn: float | None = None
    fail: float | None = None

    @property
    def verdict(self) -> Verdict:
        """Verdict of the figure's amount against its bounds."""
        amount = abs(self.value)
        if not np.isfinite(amount) or (self.fail is not None and amount > self.fail):
            return "fail"
        return "warn" if self.warn is not None and amount > self.warn else "pass"


@dataclass(slots=True, kw_only=True, eq=False)
class DeviceCheck:
    """Takes the frames of a camera that looks at a still surface."""

    described: SourceDescription
    _times_us: list[int] = field(default_factory=list)
    _received_ns: list[int] = field(default_factory=list)
    _color_lag_us: list[int] = field(default_factory=list)
    _missed: int = 0
    _repeated: int = 0
    _depth_mm: list[float] = field(default_factory=list)
    _read_share: list[float] = field(default_factory=list)
    _steps: dict[int, list[float]] = field(default_factory=lambda: {side: [] for side in SQUARES_PX})
    _last: FloatArray | None = None

    def add(self, frame: RgbdFrame) -> None:
        """Take the next frame."""
        self._times_us.append(frame.timestamp_us)
        self._received_ns.append(frame.received_ns)
        self._color_lag_us.append(frame.color_timestamp_us - frame.timestamp_us)
        self._missed += frame.missed_frames if len(self._times_us) > 1 else 0
        part = _middle(frame)
        self._read_share.append(float(np.isfinite(part).mean()))
        self._depth_mm.append(float(np.nanmedian(part)) if np.isfinite(part).any() else float("nan"))
        if self._last is not None and self._last.shape == part.shape:
            self._repeated += int(np.array_equal(part, self._last, equal_nan=True))
            for side in SQUARES_PX:
                difference = _means(part, side) - _means(self._last, side)
                known = difference[np.isfinite(difference)]
                if len(known) > 1:
                    self._steps[side].append(float(np.median(np.abs(known))))
        self._last = part

    @property
    def frames(self) -> int:
        """How many frames were taken."""
        return len(self._times_us)

    def findings(self) -> list[DeviceFinding]:
        """Return every figure; empty below `LEAST_FRAMES`."""
        if self.frames < LEAST_FRAMES:
            return []
        return [*self._timing(), *self._picture()]

    def _timing(self) -> Iterator[DeviceFinding]:
        times_s = (np.array(self._times_us, dtype=float) - self._times_us[0]) / US_PER_S
        host_s = (np.array(self._received_ns, dtype=float) - self._received_ns[0]) / (NS_PER_US * US_PER_S)
        steps_s = np.diff(times_s)
        due = self.described.fps
        rate = (self.frames - 1 + self._missed) / max(times_s[-1], 1e-6)
        yield DeviceFinding(
            code="rate", title="frames a second, less the nominal", value=rate - due, unit="1/s", warn=0.5, fail=1.5
        )
        lost = 100.0 * self._missed / (self.frames + self._missed)
        yield DeviceFinding(code="missed", title="frames that never came", value=lost, unit="%", warn=0.1, fail=1.0)
        yield DeviceFinding(
            code="gap", title="longest gap", value=1000.0 * float(steps_s.max()), unit="ms", warn=70.0, fail=100.0
        )
        back = float((steps_s <= 0.0).sum())
        yield DeviceFinding(code="back", title="steps of the clock that do not go on", value=back, unit="", fail=0.0)
        slope, offset_s = np.polyfit(times_s, host_s, 1)
        late_ms = 1000.0 * (host_s - slope * times_s - offset_s)
        late_ms -= late_ms.min()
        yield DeviceFinding(
            code="clock",
            title="clock against the host's",
            value=1e6 * (slope - 1.0),
            unit="ppm",
            warn=200.0,
            fail=1000.0,
        )
        yield DeviceFinding(
            code="jitter",
            title="arrival beyond the promptest, 99 %",
            value=float(np.percentile(late_ms, 99.0)),
            unit="ms",
            warn=15.0,
            fail=50.0,
        )
        lag_ms = float(np.median(self._color_lag_us)) / 1000.0
        yield DeviceFinding(
            code="colour", title="colour after depth, median", value=lag_ms, unit="ms", warn=34.0, fail=100.0
        )
        yield DeviceFinding(
            code="repeated", title="pictures that came again", value=float(self._repeated), unit="", fail=0.0
        )

    def _picture(self) -> Iterator[DeviceFinding]:
        depth_mm, times_s = np.array(self._depth_mm), np.array(self._times_us) / US_PER_S
        yield DeviceFinding(
            code="distance", title="distance of the surface", value=float(np.nanmedian(depth_mm)), unit="mm"
        )
        unread = 100.0 * (1.0 - float(np.mean(self._read_share)))
        yield DeviceFinding(code="holes", title="pixels without a reading", value=unread, unit="%", warn=5.0, fail=30.0)
        for side in SQUARES_PX:
            # The median of absolute differences of two frames, as a standard deviation of one.
            noise_mm = (
                float(np.median(self._steps[side])) / (0.6745 * np.sqrt(2.0)) if self._steps[side] else float("nan")
            )
            bounds = {1: (4.0, 8.0), 16: (0.8, 1.6)}.get(side, (None, None))
            title = f"noise of squares of {side} px" if side > 1 else "noise of a pixel"
            yield DeviceFinding(
                code=f"noise_{side}", title=title, value=noise_mm, unit="mm", warn=bounds[0], fail=bounds[1]
            )
        first, last = depth_mm[times_s < times_s[0] + SPAN_S], depth_mm[times_s > times_s[-1] - SPAN_S]
        drift_mm = float(np.nanmean(last) - np.nanmean(first))
        yield DeviceFinding(
            code="drift",
            title="last seconds less the first ones: warm-up",
            value=drift_mm,
            unit="mm",
            warn=0.5,
            fail=2.0,
        )


def _middle(frame: RgbdFrame) -> FloatArray:
    """Return the middle of a depth picture [mm], NaN where there is no reading."""
    rows, columns = frame.depth_mm.shape
    high, wide = int(rows * PART), int(columns * PART)
    top, left = (rows - high) // 2, (columns - wide) // 2
    part = frame.depth_mm[top : top + high, left : left + wide].astype(np.float64)
    return np.where(part > 0.0, part, np.nan)


def _means(part: FloatArray, side: int) -> FloatArray:
    """Return means of whole squares without holes, NaN elsewhere."""
    rows, columns = (size // side for size in part.shape)
    squares = part[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return np.asarray(squares.mean(axis=(1, 3)))
