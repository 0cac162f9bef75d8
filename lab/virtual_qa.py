"""A virtual QA set-up: a camera over a flat plate, a platform that moves it in sines, and a simulated beam line.

For tests and demonstrations; it is never mixed with real equipment. The camera has a quarter of the usual pixels, for
speed, and otherwise the sensor's noise, depth steps and rounding to whole millimetres. `RigFaults` seeds errors of the
sizes that QA has to detect.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from engine.beam.heartbeat_drill import DrilledReceiver
from engine.beam.simulated import SimulatedAccelerator, SimulatedBeamLine, SimulatedReceiver
from engine.calibration.camera_calibration import Calibration
from engine.capture.source import SourceDescription
from engine.control.watchdog import Watchdog
from engine.core.clock import NS_PER_MS, NS_PER_US, ManualClock
from engine.core.errors import SourceEndedError
from engine.core.frames import BoolArray, ColorImage, DepthImage, RgbdFrame
from engine.core.geometry import Intrinsics, RigidTransform
from engine.gating.limits import GateLimits
from engine.gating.windows import amplitude_window
from engine.qa.bounds import QaBaseline
from engine.qa.inputs import BeamInput, PhantomInput, PlateInput, QaInputs
from engine.qa.trace import CommandedTrace
from lab.phantom.body import Map, blur
from lab.phantom.color import stick
from lab.phantom.sensor import SENSORS, SHIFTS, USUAL, depth_table_mm, shift_of
from lab.phantom.view import Rays

Grid = npt.NDArray[np.float64]
WIDTH_PX, HEIGHT_PX = 320, 240
FPS = 29.97
FIRST_US = 1_000_000
JITTER_US = 180.0
DISTANCE_MM = 850.0
ACCELERATOR_MS = 20.0
TILT_X_DEG, TILT_Y_DEG = 2.0, 1.0
AMPLITUDE_MM = 10.0
LEVEL_MM = AMPLITUDE_MM
LEAD_IN_S = 4.0
LEAD_INS = 5
"""Sines before the first evaluated one: the pipeline is trained on them."""

PERIODS_S = (2.3, 3.1, 5.3, 8.1)
CYCLES_EACH = 3
SLIDE_S = (21.0, 23.0)
"""Span of time over which a seeded position error of the phantom is applied [s]: after the reference was set."""

TRACE_STEP_S = 0.02
MARKERS_MM = np.array([(-95.0, -150.0), (95.0, -150.0), (95.0, 150.0), (-95.0, 150.0)])
_PLATE_HALF_MM = (260.0, 220.0)
_PLATE_GREY, _ROOM_GREY = 92, 120
_GREY_NOISE = 1.5
_ROOM_MM = 1100.0
_MARGIN_PX = 64
_BANK = 6
_BLUR_PX = 1.3

_CAMERA = Intrinsics(width=WIDTH_PX, height=HEIGHT_PX, fx=288.0, fy=288.0, cx=159.5, cy=119.5)
VIRTUAL_CALIBRATION = Calibration(
    camera="virtual QA camera",
    depth=_CAMERA,
    color=_CAMERA,
    color_from_depth=RigidTransform(rotation=np.eye(3), translation_mm=np.array([25.0, 0.0, 0.0])),
)
VIRTUAL_BASELINE = QaBaseline(
    expected={
        "camera_distance_mm": DISTANCE_MM,
        "camera_tilt_x_deg": TILT_X_DEG,
        "camera_tilt_y_deg": TILT_Y_DEG,
    }
)


@dataclass(frozen=True, slots=True, kw_only=True)
class RigFaults:
    """Seeded errors of the set-up; zero is a healthy one.

    Attributes
    ----------
    offset_mm
        How much nearer to the camera the plate is than it should be; the phantom from `SLIDE_S` on.
    delay_ms
        Age of the scene that each frame shows.
    duty_change_percent
        Change of the duty cycle that the phantom's level is shifted for.
    drift_mm_per_min
        Drift of the camera's readings.
    """

    offset_mm: float = 0.0
    delay_ms: float = 0.0
    duty_change_percent: float = 0.0
    drift_mm_per_min: float = 0.0

    @property
    def phantom_mm(self) -> float:
        """Position error of the phantom [mm]; negative is farther from the camera, and longer inside the window."""
        return self.offset_mm - AMPLITUDE_MM * math.sin(math.pi * self.duty_change_percent / 100.0)


HEALTHY = RigFaults()


def virtual_inputs(faults: RigFaults = HEALTHY, *, seed: int = 1, plate_s: float = 40.0) -> QaInputs:
    """Make plate, phantom and beam line, the inputs of any kind of run."""
    return QaInputs(
        plate=virtual_plate(faults, seed=seed, seconds=plate_s),
        phantom=virtual_phantom(faults, seed=seed),
        beam=virtual_beam(),
    )


def virtual_plate(faults: RigFaults = HEALTHY, *, seed: int = 1, seconds: float = 40.0) -> PlateInput:
    """Make a plate at rest; the camera drifts only with such ``faults``."""

    def height_mm(at_s: float) -> float:
        return faults.offset_mm + faults.drift_mm_per_min * at_s / 60.0

    return PlateInput(source=VirtualPlate(height_mm, seconds, seed, has_markers=False), calibration=VIRTUAL_CALIBRATION)


def virtual_phantom(
    faults: RigFaults = HEALTHY,
    *,
    seed: int = 1,
    periods_s: tuple[float, ...] = PERIODS_S,
    cycles_each: int = CYCLES_EACH,
) -> PhantomInput:
    """Make a platform that follows a trace of sines, except for the seeded faults."""
    trace = sines(periods_s, cycles_each)
    first_s, last_s = trace.span_s

    def height_mm(at_s: float) -> float:
        commanded_s = min(max(at_s - faults.delay_ms / 1000.0, first_s), last_s)
        slid = min(max((at_s - SLIDE_S[0]) / (SLIDE_S[1] - SLIDE_S[0]), 0.0), 1.0)
        return float(trace.at(np.array([commanded_s]))[0]) + slid * faults.phantom_mm

    window_mm = (-60.0, LEVEL_MM)
    return PhantomInput(
        source=VirtualPlate(height_mm, last_s, seed),
        calibration=VIRTUAL_CALIBRATION,
        trace=trace,
        window_mm=window_mm,
        limits=GateLimits(window=amplitude_window(lower_mm=window_mm[0], upper_mm=window_mm[1]), is_played=True),
    )


def virtual_beam(repeats: int = 10, *, accelerator_ms: float = ACCELERATOR_MS) -> BeamInput:
    """Make a simulated line on a clock that advances only in ``wait_ns``, and an accelerator that follows it."""
    time = StandingTime()
    line = SimulatedBeamLine(time.clock)
    receiver = DrilledReceiver(name="simulated", line=line, second_input=SimulatedReceiver(line, time.clock))
    return BeamInput(
        line=line,
        clock=time.clock,
        wait_ns=time.wait_ns,
        repeats=repeats,
        watched=time.watched,
        receivers=(receiver,),
        beam_on=SimulatedAccelerator(line, time.clock, delay_ms=accelerator_ms).read,
    )


def sines(periods_s: tuple[float, ...], cycles_each: int) -> CommandedTrace:
    """Make a trace of sines between 0 and twice the amplitude, each starting at the top, one period after the other."""
    lengths = [LEAD_IN_S] * LEAD_INS + [period for period in periods_s for _ in range(cycles_each)]
    ends_s = np.cumsum(lengths)
    time_s = np.arange(0.0, ends_s[-1], TRACE_STEP_S)
    number = np.minimum(np.searchsorted(ends_s, time_s, side="right"), len(lengths) - 1)
    period = np.array(lengths)[number]
    position = AMPLITUDE_MM * (1.0 + np.cos(2.0 * np.pi * (time_s - (ends_s[number] - period)) / period))
    return CommandedTrace(time_s=time_s, position_mm=position)


class StandingTime:
    """A clock that advances only in `wait_ns`, and checks a watchdog each time it does."""

    def __init__(self) -> None:
        self.clock = ManualClock(now_ns=NS_PER_MS)
        self._watchdog: Watchdog | None = None

    def wait_ns(self, span_ns: int) -> None:
        """Advance the clock by a span [ns], at least 1 us, and check the watchdog."""
        self.clock.advance_ns(max(span_ns, NS_PER_US))
        if self._watchdog is not None:
            self._watchdog.check(self.clock.now_ns())

    @contextmanager
    def watched(self, watchdog: Watchdog) -> Iterator[None]:
        """Check this watchdog at every advance of the clock while the block runs."""
        self._watchdog = watchdog
        try:
            yield
        finally:
            self._watchdog = None


class VirtualPlate:
    """A `DepthSource` of a plate with four markers that is ``height_mm(t)`` above its position of rest."""

    def __init__(
        self, height_mm: Callable[[float], float], seconds: float, seed: int, *, has_markers: bool = True
    ) -> None:
        self._height_mm = height_mm
        self._has_markers = has_markers
        self._frames = int(seconds * FPS)
        self._seed = seed
        self._rays = Rays.of(_CAMERA)
        self._sensor = _Sensor(seed)
        self._background = self._paint_background()
        self._next = 0

    def open(self) -> SourceDescription:
        """Restart at the first frame."""
        self._next = 0
        size = (WIDTH_PX, HEIGHT_PX)
        return SourceDescription(
            kind="virtual", name="virtual QA plate", depth_size=size, color_size=size, fps=FPS, is_live=False
        )

    def read(self, timeout_s: float) -> RgbdFrame:  # noqa: ARG002 - frames are made, not waited for
        """Render the next frame; raise SourceEndedError after the last."""
        if self._next >= self._frames:
            msg = "the virtual plate has no more frames"
            raise SourceEndedError(msg)
        index, self._next = self._next, self._next + 1
        rng = np.random.default_rng((self._seed, 8, index))
        at_s = index / FPS
        if index:
            at_s += float(rng.uniform(-0.5, 0.5)) * JITTER_US * 1e-6
        distance_mm = DISTANCE_MM - self._height_mm(at_s)
        timestamp_us = FIRST_US + round(at_s * 1e6)
        return RgbdFrame(
            index=index,
            device_index=index,
            timestamp_us=timestamp_us,
            color_timestamp_us=timestamp_us,
            received_ns=timestamp_us * NS_PER_US,
            depth_mm=self._depth(distance_mm, rng),
            color=self._color(distance_mm, rng),
        )

    def close(self) -> None:
        """Do nothing: the source holds no resource."""

    def _plane_mm(self, distance_mm: float) -> Map:
        """Depth of the plate's plane along each ray [mm], shape (H, W)."""
        x, y = self._rays.singles
        lean_x, lean_y = _lean()
        plane = np.float32(distance_mm) / (np.float32(1.0) + np.float32(lean_x) * x + np.float32(lean_y) * y)
        return np.asarray(plane, dtype=np.float32)

    def _is_plate(self, plane_mm: Map, shift_x_mm: float = 0.0) -> BoolArray:
        x, y = self._rays.singles
        half_x, half_y = _PLATE_HALF_MM
        return np.asarray((np.abs(plane_mm * x - np.float32(shift_x_mm)) < half_x) & (np.abs(plane_mm * y) < half_y))

    def _depth(self, distance_mm: float, rng: np.random.Generator) -> DepthImage:
        plane_mm = self._plane_mm(distance_mm)
        room_mm = np.float32(_ROOM_MM) + np.float32(300.0) * self._rays.singles[0]
        return self._sensor.read(np.where(self._is_plate(plane_mm), plane_mm, room_mm), rng)

    def _paint_background(self) -> ColorImage:
        """Paint the plate, which hardly moves in the picture, once; the markers are drawn per frame."""
        shift_x_mm = float(VIRTUAL_CALIBRATION.color_from_depth.translation_mm[0])
        is_plate = self._is_plate(self._plane_mm(DISTANCE_MM), shift_x_mm)
        grey = np.where(is_plate, np.uint8(_PLATE_GREY), np.uint8(_ROOM_GREY)).astype(np.uint8)
        picture: ColorImage = np.repeat(grey[..., None], 3, axis=2)
        return picture

    def _color(self, distance_mm: float, rng: np.random.Generator) -> ColorImage:
        if not self._has_markers:
            return self._background.copy()
        picture = self._background.copy()
        lean_x, lean_y = _lean()
        depth_mm = distance_mm - lean_x * MARKERS_MM[:, 0] - lean_y * MARKERS_MM[:, 1]
        centers = np.column_stack([MARKERS_MM, depth_mm])
        slopes = np.tile([lean_x, lean_y], (len(centers), 1))
        pose = VIRTUAL_CALIBRATION.color_from_depth
        stick(picture, _CAMERA, self._rays, pose, centers, slopes, np.ones(len(centers)))
        return np.asarray(cv2.add(picture, self._sensor.grain(rng), dtype=cv2.CV_8U), dtype=np.uint8)


def _lean() -> tuple[float, float]:
    """Slopes of the plate [mm/mm]: how much nearer it is per mm to the right, and per mm down."""
    return math.tan(math.radians(TILT_X_DEG)), math.tan(math.radians(TILT_Y_DEG))


class _Sensor:
    """The virtual volunteers' depth sensor at a quarter of the pixels; its noise comes from a small bank of fields."""

    def __init__(self, seed: int) -> None:
        self._table = depth_table_mm()
        rng = np.random.default_rng((seed, 3))
        size = (HEIGHT_PX + _MARGIN_PX, WIDTH_PX + _MARGIN_PX)
        self._bank = [_of_unit_variance(rng.standard_normal(size, dtype=np.float32)) for _ in range(_BANK)]
        grain = rng.standard_normal((*size, 3), dtype=np.float32) * np.float32(_GREY_NOISE)
        self._grain = np.rint(grain).astype(np.int16)
        self._pattern = _of_unit_variance(rng.standard_normal((HEIGHT_PX, WIDTH_PX), dtype=np.float32), 3.0)

    def read(self, depth_mm: Map, rng: np.random.Generator) -> DepthImage:
        """Apply noise and the sensor's depth steps; return whole millimetres, uint16."""
        shift = np.asarray(shift_of(depth_mm), dtype=np.float32)
        shift += self._pattern * np.float32(SENSORS[USUAL].pattern_shifts)
        shift += self.draw(rng) * np.float32(SENSORS[USUAL].noise_shifts)
        index = np.clip(np.rint(shift), 0, SHIFTS - 1).astype(np.uint16)
        return np.asarray(self._table[index], dtype=np.uint16)

    def grain(self, rng: np.random.Generator) -> npt.NDArray[np.int16]:
        """Return a colour picture's noise [grey levels], shape (H, W, 3); no two pictures have the same."""
        channels = [
            self._grain[top : top + HEIGHT_PX, left : left + WIDTH_PX, channel]
            for channel, (top, left) in enumerate(rng.integers(0, _MARGIN_PX + 1, (3, 2)))
        ]
        return np.stack(channels, axis=2)

    def draw(self, rng: np.random.Generator) -> Map:
        """Return the sum of two fields of the bank at random offsets and signs, of unit variance, shape (H, W)."""
        total = np.zeros((HEIGHT_PX, WIDTH_PX), np.float32)
        for number in rng.choice(_BANK, 2, replace=False):
            top, left = rng.integers(0, _MARGIN_PX + 1, 2)
            sign = np.float32(math.copysign(math.sqrt(0.5), rng.uniform(-1.0, 1.0)))
            total += sign * self._bank[number][top : top + HEIGHT_PX, left : left + WIDTH_PX]
        return total


def _of_unit_variance(field: Map, blur_px: float = _BLUR_PX) -> Map:
    blurred = blur(field, blur_px)
    return np.asarray(blurred / blurred.std(), dtype=np.float32)
