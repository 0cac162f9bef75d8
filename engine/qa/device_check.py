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
from engine.core.geometry import Intrinsics
from engine.qa.surface_fit import fit_cylinder, fit_plane, points_mm

PART = 0.25
"""Share of the picture's width and height that is looked at, in its middle."""
SQUARES_PX = (1, 4, 8, 16)
LEAST_FRAMES = 90
CURVE_POINTS = 120
SEEN_SHARE = 0.5
"""A pixel counts in the mean picture where so many frames have a reading."""
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
    """Takes the frames of a camera that looks at a still surface.

    Attributes
    ----------
    described
        The camera.
    depth
        Its depth camera, for the shape of the surface; None where it is not known.
    radius_mm
        Radius of the drum that it looks at [mm]; None for a plane.
    """

    described: SourceDescription
    _times_us: list[int] = field(default_factory=list)
    _received_ns: list[int] = field(default_factory=list)
    _color_lag_us: list[int] = field(default_factory=list)
    _missed: int = 0
    _repeated: int = 0
    _depth_mm: list[float] = field(default_factory=list)
    _read_share: list[float] = field(default_factory=list)
    _steps: dict[int, list[float]] = field(default_factory=lambda: {side: [] for side in SQUARES_PX})
    depth: Intrinsics | None = None
    radius_mm: float | None = None
    _last: FloatArray | None = None
    _sum_mm: FloatArray | None = None
    _counts: FloatArray | None = None
    _temperatures_c: list[float] = field(default_factory=list)

    def add(self, frame: RgbdFrame, temperature_c: float | None = None) -> None:
        """Take the next frame, and the camera's temperature where it tells one [degrees C]."""
        self._temperatures_c.append(float("nan") if temperature_c is None else temperature_c)
        self._times_us.append(frame.timestamp_us)
        self._received_ns.append(frame.received_ns)
        self._color_lag_us.append(frame.color_timestamp_us - frame.timestamp_us)
        self._missed += frame.missed_frames if len(self._times_us) > 1 else 0
        part = _middle(frame)
        self._read_share.append(float(np.isfinite(part).mean()))
        known = np.isfinite(part)
        total_mm = np.where(known, part, 0.0)
        if self._sum_mm is None or self._counts is None or self._sum_mm.shape != part.shape:
            self._sum_mm, self._counts = np.zeros(part.shape), np.zeros(part.shape)
        self._sum_mm += total_mm
        self._counts += known
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

    def curve(self) -> list[dict[str, float | None]]:
        """Return depth and temperature over time, means of equal parts, at most `CURVE_POINTS`."""
        times_s = (np.array(self._times_us, dtype=float) - self._times_us[0]) / US_PER_S
        parts = np.array_split(np.arange(self.frames), min(CURVE_POINTS, max(self.frames // LEAST_FRAMES, 1)))
        columns = {"s": times_s, "depth_mm": np.array(self._depth_mm), "temperature_c": np.array(self._temperatures_c)}
        return [{name: _mean(values[part]) for name, values in columns.items()} for part in parts]

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
            bounds = {1: (4.0, 8.0), 16: (0.8, 1.2)}.get(side, (None, None))
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
        yield from self._shape()
        known_c = [one for one in self._temperatures_c if np.isfinite(one)]
        if known_c:
            yield DeviceFinding(code="temperature", title="temperature at the end", value=known_c[-1], unit="deg C")
            warmed_c = known_c[-1] - known_c[0]
            yield DeviceFinding(code="warmed", title="temperature, last less first", value=warmed_c, unit="deg C")

    def _shape(self) -> Iterator[DeviceFinding]:
        """Yield how far the mean picture is from a plane, or from the drum."""
        if self.depth is None or self._sum_mm is None or self._counts is None:
            return
        mean_mm = np.where(
            self._counts >= SEEN_SHARE * self.frames, self._sum_mm / np.maximum(self._counts, 1.0), np.nan
        )
        rows, columns = np.mgrid[_window(self.depth.height), _window(self.depth.width)]
        rays = self.depth.rays(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
        points = points_mm(mean_mm, rays.reshape(*mean_mm.shape, 3))
        found = fit_plane(points) if self.radius_mm is None else fit_cylinder(points, self.radius_mm)
        if found is None:
            return
        what = "a plane" if self.radius_mm is None else "a cylinder"
        yield DeviceFinding(
            code="flatness", title=f"mean picture off {what}", value=found.rest_mm, unit="mm", warn=1.0, fail=3.0
        )
        if self.radius_mm is not None:
            yield DeviceFinding(
                code="radius",
                title="radius of the drum, less the true one",
                value=found.radius_mm - self.radius_mm,
                unit="mm",
                warn=2.0,
                fail=5.0,
            )


def _mean(values: FloatArray) -> float | None:
    known = values[np.isfinite(values)]
    return round(float(known.mean()), 3) if len(known) else None


def _middle(frame: RgbdFrame) -> FloatArray:
    """Return the middle of a depth picture [mm], NaN where there is no reading."""
    rows, columns = frame.depth_mm.shape
    part = frame.depth_mm[_window(rows), _window(columns)].astype(np.float64)
    return np.where(part > 0.0, part, np.nan)


def _window(size: int) -> slice:
    """Return the middle part of a side of the picture."""
    part = int(size * PART)
    return slice((size - part) // 2, (size - part) // 2 + part)


def _means(part: FloatArray, side: int) -> FloatArray:
    """Return means of whole squares without holes, NaN elsewhere."""
    rows, columns = (size // side for size in part.shape)
    squares = part[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return np.asarray(squares.mean(axis=(1, 3)))
