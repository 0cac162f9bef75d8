"""A structured-light depth sensor with the errors measured on real recordings.

It works in its own unit, shift: ``depth_cm = m * 120 / (7.5 - m) + 120``, ``m = ((shift - 800) / 4 - 0.375) * zpps``.
In shift, noise is the same at any depth: white in time, correlated over a few pixels, uncorrelated beyond; a fixed
pattern adds to it, and rare jumps in small clusters, most of them at edges. Readings are rounded to whole shifts, then
to whole mm. A unit's scale has an error of some per cent and drifts while it warms up. Noise and patterns are those of
one of the two models below.

Noise comes from a bank of fields made once: each frame adds two of them with random offsets, flips and signs, which is
many times faster than new fields; no two frames use the same pair.

There are two models of the same sensor, so that a method is not tuned to the errors of one. The noise of ``usual`` is
fitted to a Carmine's recording. ``locking`` has noise with the reach of a Kinect's, and *pixel locking*: the matching
of structured light prefers certain sub-pixel positions, which differ from place to place. This error is fixed to the
pixel. Its period is one pixel of disparity, 8 steps; the matching window makes it smooth over 9 px. Over the depth
range of a breath it is a wrong local gain, the same in every breath.

Two further models are of other kinds of sensors, each figure with its source in `KINDS_OF_ERROR`:

``active-stereo`` matches two infrared pictures 50 mm apart. Its unit is disparity, ``f B / z``, in steps of 1/32 px;
the noise follows the local texture, and edges are fattened by half the matching window: near surfaces grow.
``time-of-flight`` measures range. Its noise grows with the square of the range, differs with the texture and is nearly
white in space; a periodic error swings with the range; at edges near and far are mixed.

Holes are pixels without a reading: shadows of the projector, steep and shiny surfaces, the picture's rim, dark objects.
They are not sharp: near their edges readings flicker from frame to frame. `Holes.level` is, for each pixel, the level
that a standard normal draw must exceed for a reading: -inf always reads, +inf never.
"""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.errors import InvalidValueError
from engine.core.frames import BoolArray, DepthImage, FloatArray
from lab.phantom.body import Map, Material, blur
from lab.phantom.builds import Build
from lab.phantom.rig import HEIGHT_PX, PROJECTOR_BASELINE_MM, STEPS_A_MM, WIDTH_PX, ZERO_PLANE_PX_SIZE

HOLE_SHARE = 0.245
FLICKER_SHARE = 0.07
RIM_PX = 6
PATCH_PX = 4.0
_STEEPEST = 2.2
_SHADOW_SLACK_PX = 0.6
# In the flicker zone a pixel has a reading in 7 to 93 % of the frames.
_ZONE_LEVEL = 1.5
STEPS_A_PX = 8
"""Steps of the sensor in one pixel of disparity."""
WINDOW_PX = 9
"""Side of the matching window."""
USUAL = "usual"
DRAWN = "drawn-"
"""Beginning of the name of a sensor whose parameters are drawn; its number follows."""
MOST_DRAWN = 1000
STRUCTURED_LIGHT = "structured-light"
DISPARITY_STEPS = 32
"""Steps of a D4xx in one pixel of disparity."""
BENCHED = (USUAL, "locking")
"""The models of the article's sensor, on which every bench runs; the others where they are asked for."""
KINDS_OF_ERROR = {
    "active-stereo": "sub-pixel noise 0.05 to 0.1 px, steps of 1/32 px: Intel's notes on tuning, and Keselman 2017; "
    "noise with the texture, and edges that fatten: Giancola 2018",
    "time-of-flight": "noise, mixed pixels and error with range: PMC7827245 (Azure Kinect, whose sensor and modes a "
    "Femto Bolt has); periodic error: Foix 2011",
}
"""Where the figures of the models that were not fitted to recordings come from."""
LEAST_NOISE_SHIFTS = 0.1
"""What is left of noise that is left out: without any, the pictures of a body at rest are equal, and refused."""
ERRORS: dict[str, dict[str, float | bool]] = {
    "noise": {"noise_shifts": LEAST_NOISE_SHIFTS},
    "pattern": {"pattern_shifts": 0.0},
    "locking": {"locking_shifts": 0.0, "common_locking_shifts": 0.0},
    "steps": {"is_stepped": False},
}
"""Each error of a sensor that can be left out, and the model without it."""
SHIFTS = 2048
NEAREST_MM, FARTHEST_MM = 350, 9500
JUMPS_A_FRAME = 200.0
JUMP_PX = 3
WARM_UP_SHARE = 0.0012
WARM_UP_S = 700.0
_BANK = 8
_MARGIN_PX = 128
# The shift of infinite depth.
_FAR_SHIFT = 4.0 * (7.5 / ZERO_PLANE_PX_SIZE + 0.375) + 800.0
_STEP_MM = 25.0
"""Two surfaces this far apart are two, with an edge between."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Holes:
    """Holes of one pose: the level of a reading, and the edges, where jumps are frequent, both of shape (H, W)."""

    level: Map
    is_edge: BoolArray


def cast_shadow(depth_mm: FloatArray, focal_px: float) -> BoolArray:
    """Pixels in the projector's shadow, for a projector beside the camera in +x, shape (H, W)."""
    columns = np.arange(depth_mm.shape[1], dtype=np.float32)
    projector_columns = columns - np.float32(focal_px * PROJECTOR_BASELINE_MM) / depth_mm
    nearest = np.minimum.accumulate(projector_columns[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(projector_columns > nearest + np.float32(_SHADOW_SLACK_PX))


def find_holes(
    depth_mm: FloatArray,
    focal_px: float,
    *,
    material: npt.NDArray[np.uint8],
    is_shiny: BoolArray,
    is_room: BoolArray,
    darkness: FloatArray,
    body_share: float | None,
    is_body: BoolArray,
) -> Holes:
    """Lay out the holes of one pose.

    Parameters
    ----------
    depth_mm
        True depth at rest, shape (H, W).
    material
        Material of the body at each pixel, shape (H, W).
    is_shiny
        Patches of the shirt that reflect the projector, shape (H, W).
    is_room
        Pixels of the floor, where dark objects stand, shape (H, W).
    darkness
        A fixed smooth random field; the floor has no reading where it is highest, up to the share `HOLE_SHARE`.
    body_share, is_body
        Additional share of the body without a reading, in patches of about 1 cm; None for none.
    """
    never = cast_shadow(depth_mm, focal_px) | _is_steep(depth_mm, focal_px) | is_shiny
    never |= material == Material.HAIR
    never[:RIM_PX] = never[-RIM_PX:] = True
    never[:, :RIM_PX] = never[:, -RIM_PX:] = True
    if body_share is not None:
        never |= _patches(is_body, body_share)
    missing = int(HOLE_SHARE * never.size) - int(np.count_nonzero(never))
    free = is_room & ~never
    if missing > 0 and free.any():
        share = min(1.0, missing / int(np.count_nonzero(free)))
        never |= free & (darkness > np.quantile(darkness[free], 1.0 - share))
    never = cv2.medianBlur(never.astype(np.uint8), 3) > 0
    outside = cv2.distanceTransform((~never).astype(np.uint8), cv2.DIST_L2, 3)
    inside = cv2.distanceTransform(never.astype(np.uint8), cv2.DIST_L2, 3)
    # A rough edge: whole-pixel distances have too few values for an exact share.
    rough = np.random.default_rng(9).uniform(-0.4, 0.4, never.shape)
    distance = np.where(never, 0.5 - inside, outside - 0.5) + rough
    reach = float(np.quantile(np.abs(distance), FLICKER_SHARE))
    level = np.where(never, np.inf, -np.inf).astype(np.float32)
    zone = np.abs(distance) <= reach
    level[zone] = -_ZONE_LEVEL * distance[zone] / reach
    return Holes(level=level, is_edge=zone & ~never)


def _patches(is_body: BoolArray, share: float) -> BoolArray:
    """Random patches that cover a share of the body, shape (H, W)."""
    field = blur(np.random.default_rng(10).standard_normal(is_body.shape, dtype=np.float32), PATCH_PX)
    if share <= 0.0:
        return np.zeros_like(is_body)
    return np.asarray(is_body & (field >= np.quantile(field[is_body], 1.0 - share)))


def _is_steep(depth_mm: FloatArray, focal_px: float) -> BoolArray:
    """Pixels whose surface is so oblique that too little light returns."""
    down, right = np.gradient(depth_mm)
    return np.asarray(np.hypot(down, right) * focal_px / depth_mm > _STEEPEST)


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorModel:
    """Errors of a sensor in shifts, its own unit.

    Attributes
    ----------
    noise_shifts
        Standard deviation of the temporal noise, before rounding.
    noise_parts
        Share of its variance and blur [px] of each part of the noise; a blur of 0 is white.
    pattern_shifts, pattern_blur_px
        The constant error of each pixel.
    locking_shifts
        Root mean square over the pixels of the amplitude of the error that varies with the sub-pixel phase.
    locking_window_px
        Over how many rows and columns this error is the same: the window of the matching.
    common_locking_shifts
        Amplitude of the part of this error that is the same at every pixel: it depends on the phase alone.
    is_stepped
        Whether readings are whole steps of the sensor's unit; whole millimetres they are in any case.
    focal_baseline_mm
        Focal length times baseline [px mm] of a stereo camera, whose unit is 1/32 px of disparity; 0 for the others.
    range_noise_mm
        Standard deviation of the noise of a time-of-flight camera at 1 m on white cloth [mm]; 0 for the others.
    texture
        How much the noise differs from place to place: standard deviation of its logarithm.
    fatten_px
        How far a near surface covers the far one behind its edge [px].
    mixed_px
        Width over which near and far are mixed at an edge [px].
    periodic_mm, period_mm
        Amplitude and period of the error that swings with the range [mm].
    """

    noise_shifts: float
    noise_parts: tuple[tuple[float, float], ...]
    pattern_shifts: float
    pattern_blur_px: float
    locking_shifts: float = field(default=0.0)
    locking_window_px: tuple[int, int] = (WINDOW_PX, WINDOW_PX)
    common_locking_shifts: float = 0.0
    is_stepped: bool = True
    focal_baseline_mm: float = 0.0
    range_noise_mm: float = 0.0
    texture: float = 0.0
    fatten_px: int = 0
    mixed_px: int = 0
    periodic_mm: float = 0.0
    period_mm: float = 0.0


SENSORS = {
    # Noise as `tidegate evaluate sensor --fit` finds it in 24 frames of a Carmine (evaluation.md).
    "usual": SensorModel(
        noise_shifts=0.41,
        noise_parts=((0.07, 0.0), (0.44, 1.0), (0.49, 2.9)),
        pattern_shifts=0.2,
        pattern_blur_px=3.0,
    ),
    # Noise with the reach of a Kinect's, and locking of 0.35 mm at 0.85 m, where a step is 2.1 mm.
    "locking": SensorModel(
        noise_shifts=0.45,
        noise_parts=((0.13, 0.0), (0.26, 1.35), (0.61, 3.2)),
        pattern_shifts=0.166,
        pattern_blur_px=3.0,
        locking_shifts=0.166,
    ),
    # D435 at 640 x 480: f = 383 px, baseline 50 mm. At 0.85 m 0.05 px of noise are 1.9 mm, 0.04 px that stay 1.5 mm.
    "active-stereo": SensorModel(
        noise_shifts=0.05 * DISPARITY_STEPS,
        noise_parts=((0.15, 0.0), (0.5, 1.6), (0.35, 3.0)),
        pattern_shifts=0.04 * DISPARITY_STEPS,
        pattern_blur_px=3.0,
        focal_baseline_mm=383.0 * 50.0,
        texture=0.35,
        fatten_px=3,
    ),
    # Femto Bolt and Azure Kinect, narrow field of view: about 1 mm at 1 m, systematic errors of 1 to 2 mm.
    "time-of-flight": SensorModel(
        noise_shifts=0.0,
        noise_parts=((0.8, 0.0), (0.2, 1.1)),
        pattern_shifts=0.4,
        pattern_blur_px=6.0,
        is_stepped=False,
        range_noise_mm=1.1,
        texture=0.4,
        mixed_px=3,
        periodic_mm=0.6,
        period_mm=300.0,
    ),
}
"""Sensor models by name."""
SENSORS[STRUCTURED_LIGHT] = SENSORS[USUAL]
SENSORS["active-stereo-rough"] = replace(SENSORS["active-stereo"], noise_shifts=0.1 * DISPARITY_STEPS)
"""The other end of what is published of active stereo: twice the noise."""


def drawn_sensor(number: int) -> SensorModel:
    """Draw a structured-light sensor from the ranges between cameras; the same number gives the same sensor.

    Noise and its reach span what `tidegate evaluate sensor` finds in two public recordings, of a Kinect and a Carmine.
    The strength of locking, which these are too short to show, is drawn from none to one and a half times that of
    ``locking``, the same at every pixel or not.
    """
    rng = np.random.default_rng((number, 57))
    white = rng.uniform(0.05, 0.25)
    near = rng.uniform(0.25, 0.45)
    rows, columns = rng.integers(5, 12), rng.integers(7, 22)
    return SensorModel(
        noise_shifts=rng.uniform(0.34, 0.52),
        noise_parts=((white, 0.0), (near, rng.uniform(0.9, 1.5)), (1.0 - white - near, rng.uniform(2.4, 3.3))),
        pattern_shifts=rng.uniform(0.1, 0.25),
        pattern_blur_px=3.0,
        locking_shifts=rng.uniform(0.0, 0.25),
        locking_window_px=(int(rows), int(columns)),
        common_locking_shifts=rng.uniform(0.0, 0.25),
    )


def find_sensor(name: str) -> SensorModel:
    """Return the sensor model of this name, e.g. ``usual``, ``drawn-3`` or ``locking without noise, steps``.

    Raises
    ------
    InvalidValueError
        There is no model, or no error to leave out, of this name.
    """
    base, _, left_out = name.partition(" without ")
    number = base.removeprefix(DRAWN)
    is_drawn = base.startswith(DRAWN) and number.isascii() and number.isdigit() and int(number) < MOST_DRAWN
    if base not in SENSORS and not is_drawn:
        raise InvalidValueError("sensor", name, f"one of {', '.join(SENSORS)}, or {DRAWN}N, N below {MOST_DRAWN}")
    model = drawn_sensor(int(number)) if is_drawn else SENSORS[base]
    for error in left_out.split(", ") if left_out else ():
        if error not in ERRORS:
            raise InvalidValueError("sensor", name, f"{base} without some of " + ", ".join(ERRORS))
        model = replace(model, **ERRORS[error])  # type: ignore[arg-type]
    return model


def depth_table_mm() -> npt.NDArray[np.uint16]:
    """Depth of each of the 2048 shifts [mm], truncated, shape (2048,); 0 where the sensor has no reading."""
    m = ((np.arange(SHIFTS) - 800.0) / 4.0 - 0.375) * ZERO_PLANE_PX_SIZE
    with np.errstate(divide="ignore"):
        depth_mm = np.trunc(10.0 * (m * 120.0 / (7.5 - m) + 120.0))
    is_read = (depth_mm >= NEAREST_MM) & (depth_mm <= FARTHEST_MM) & (m < 7.5)
    return np.where(is_read, depth_mm, 0).astype(np.uint16)


def shift_of(depth_mm: FloatArray) -> FloatArray:
    """Shift of a reading of ``depth_mm`` [mm], not rounded, same shape."""
    return np.asarray(_FAR_SHIFT - STEPS_A_MM / depth_mm)


@dataclass(frozen=True, slots=True, kw_only=True)
class Unit:
    """One camera unit: scale and offset of its true depth against its reading; it starts cold."""

    scale: float
    offset_mm: float
    drift_mm: float = 0.0

    @classmethod
    def of(cls, build: Build, drift_mm: float | None = None) -> "Unit":
        """Return the unit that a volunteer was recorded with, which reads ``drift_mm`` more when it starts [mm]."""
        return cls(scale=build.depth_scale, offset_mm=build.depth_offset_mm, drift_mm=drift_mm or 0.0)

    def reading_scale(self, time_s: float) -> tuple[float, float]:
        """Return (a, b) of ``reading = a * z + b`` at this time after switching on."""
        cold = float(np.exp(-time_s / WARM_UP_S))
        warm = 1.0 + WARM_UP_SHARE * cold
        return warm / self.scale, self.drift_mm * cold - warm * self.offset_mm / self.scale


class Sensor:
    """Converts true depth to the readings of one unit.

    Parameters
    ----------
    model
        The sensor model, or the name of one.
    """

    def __init__(self, unit: Unit, seed: int, model: str | SensorModel = USUAL) -> None:
        self._unit = unit
        self._seed = seed
        self._model = find_sensor(model) if isinstance(model, str) else model
        self._table = depth_table_mm()
        rng = np.random.default_rng((seed, 3))
        self._bank = [_correlated_field(rng, self._model) for _ in range(_BANK)]
        pattern = blur(rng.standard_normal((HEIGHT_PX, WIDTH_PX), dtype=np.float32), self._model.pattern_blur_px)
        self._pattern = (pattern * (self._model.pattern_shifts / pattern.std()) + _FAR_SHIFT).astype(np.float32)
        self._locking = _locking_fields((seed, 7), self._model)
        texture = blur(np.random.default_rng((seed, 8)).standard_normal((HEIGHT_PX, WIDTH_PX), dtype=np.float32), 8.0)
        self._texture = np.exp(texture * np.float32(self._model.texture / texture.std()))

    def read(
        self, depth_mm: Map, holes: Holes, *, frame: int, time_s: float, blocked: BoolArray | None = None
    ) -> DepthImage:
        """Return the readings of one frame [mm], uint16, shape (480, 640); 0 is no reading.

        Parameters
        ----------
        depth_mm
            True depth, shape (480, 640).
        holes
            The holes of this pose.
        frame
            Ordinal of the frame; its noise depends only on the seed and this number.
        time_s
            Time since the start [s].
        blocked
            Further pixels without a reading in this frame, shape (480, 640).
        """
        rng = np.random.default_rng((self._seed, 4, frame))
        scale, offset = self._unit.reading_scale(time_s)
        seen_mm = depth_mm * np.float32(scale)
        seen_mm += np.float32(offset)
        reading = self._read_otherwise(seen_mm, rng) if self._is_other else self._read_shifts(seen_mm, holes, rng)
        missing = self._draw(rng) < holes.level
        if blocked is not None:
            missing |= blocked
        reading[missing] = 0
        return reading

    @property
    def _is_other(self) -> bool:
        return self._model.focal_baseline_mm > 0.0 or self._model.range_noise_mm > 0.0

    def _read_otherwise(self, seen_mm: Map, rng: np.random.Generator) -> DepthImage:
        """Return readings of a stereo or a time-of-flight camera, without holes [mm]; ``seen_mm`` is overwritten."""
        model = self._model
        if model.fatten_px:
            seen_mm = _fattened(seen_mm, model.fatten_px)
        if model.mixed_px:
            seen_mm = _mixed(seen_mm, model.mixed_px)
        noise = self._draw(rng) * self._texture
        pattern = self._pattern - np.float32(_FAR_SHIFT)
        if model.range_noise_mm > 0.0:
            amplitude_mm = np.float32(model.range_noise_mm * 1e-6) * np.square(seen_mm)
            seen_mm += np.float32(model.periodic_mm) * np.sin(seen_mm * np.float32(2.0 * np.pi / model.period_mm))
            seen_mm += pattern + noise * amplitude_mm
            return np.where(seen_mm <= FARTHEST_MM, np.rint(seen_mm), 0.0).astype(np.uint16)
        steps = np.float32(DISPARITY_STEPS * model.focal_baseline_mm) / seen_mm
        steps += pattern + noise * np.float32(model.noise_shifts)
        if model.is_stepped:
            np.rint(steps, out=steps)
        depth_mm = np.rint(np.float32(DISPARITY_STEPS * model.focal_baseline_mm) / np.maximum(steps, 1.0))
        return np.where(depth_mm <= FARTHEST_MM, depth_mm, 0.0).astype(np.uint16)

    def _read_shifts(self, shift: Map, holes: Holes, rng: np.random.Generator) -> DepthImage:
        """Return readings of structured light, without holes [mm]; ``shift``, the depth seen [mm], is overwritten."""
        np.divide(np.float32(-STEPS_A_MM), shift, out=shift)
        shift += self._pattern
        if self._locking is not None:
            phase = shift * np.float32(2.0 * np.pi / STEPS_A_PX)
            shift += self._locking[0] * np.cos(phase) + self._locking[1] * np.sin(phase)
        shift += self._draw(rng) * np.float32(self._model.noise_shifts)
        self._jump(shift, holes, rng)
        return self._readings(shift)

    def _readings(self, shift: Map) -> DepthImage:
        """Depth of each shift [mm]; ``shift`` is overwritten."""
        if not self._model.is_stepped:
            depth_mm = np.rint(STEPS_A_MM / np.maximum(_FAR_SHIFT - shift, 1.0))
            return np.where(depth_mm <= FARTHEST_MM, depth_mm, 0).astype(np.uint16)
        index = np.clip(np.rint(shift, out=shift), 0, SHIFTS - 1, out=shift).astype(np.uint16)
        return self._table[index]

    def _draw(self, rng: np.random.Generator) -> Map:
        """Return one correlated field of unit variance."""
        first, second = rng.choice(_BANK, 2, replace=False)
        top, left, top2, left2 = rng.integers(0, _MARGIN_PX + 1, 4)
        sign = rng.choice(np.array([-1.0, 1.0]), 2) * np.sqrt(0.5)
        one = self._bank[first][top : top + HEIGHT_PX, left : left + WIDTH_PX]
        two = self._bank[second][top2 : top2 + HEIGHT_PX, left2 : left2 + WIDTH_PX]
        total = cv2.addWeighted(one, float(sign[0]), two[::-1, ::-1], float(sign[1]), 0.0)
        return np.asarray(total, dtype=np.float32)

    def _jump(self, shift: Map, holes: Holes, rng: np.random.Generator) -> None:
        count = int(rng.poisson(JUMPS_A_FRAME))
        rows, columns = rng.integers(0, HEIGHT_PX, 4 * count), rng.integers(0, WIDTH_PX, 4 * count)
        # Keep all candidates at edges and few elsewhere.
        keep = (rng.random(4 * count) < 0.027) | holes.is_edge[rows, columns]
        sizes = rng.uniform(9.0, 18.0, 4 * count) * rng.choice(np.array([-1.0, 1.0]), 4 * count)
        for row, column, size in zip(rows[keep], columns[keep], sizes[keep], strict=True):
            shift[row : row + JUMP_PX, column : column + JUMP_PX] += np.float32(size)


def _fattened(depth_mm: Map, reach_px: int) -> Map:
    """Let near surfaces cover what lies behind their edges."""
    side = 2 * reach_px + 1
    nearest = cv2.erode(depth_mm, np.ones((side, side), np.uint8))
    return np.where(depth_mm - nearest > _STEP_MM, nearest, depth_mm)


def _mixed(depth_mm: Map, width_px: int) -> Map:
    """Mix near and far at edges."""
    kernel = np.ones((width_px, width_px), np.uint8)
    is_edge = cv2.dilate(depth_mm, kernel) - cv2.erode(depth_mm, kernel) > _STEP_MM
    return np.where(is_edge, cv2.blur(depth_mm, (width_px, width_px)), depth_mm)


def _locking_fields(seed: tuple[int, int], model: SensorModel) -> tuple[Map, Map] | None:
    """Factors of the phase's cosine and sine at each pixel [shifts], each of shape (H, W); None without locking."""
    if model.locking_shifts == model.common_locking_shifts == 0.0:
        return None
    rng = np.random.default_rng(seed)
    fields = [rng.standard_normal((HEIGHT_PX, WIDTH_PX), dtype=np.float32) for _ in range(2)]
    rows, columns = model.locking_window_px
    cosine, sine = (cv2.blur(one, (columns, rows)) for one in fields)
    scale = np.float32(model.locking_shifts / np.sqrt(np.mean(cosine**2 + sine**2)))
    # The sine of a preferred place pulls readings towards it; its place differs from unit to unit.
    place = rng.uniform(0.0, 2.0 * np.pi)
    common = np.float32(model.common_locking_shifts) * np.array([np.cos(place), np.sin(place)], dtype=np.float32)
    return np.asarray(cosine * scale + common[0], dtype=np.float32), np.asarray(
        sine * scale + common[1], dtype=np.float32
    )


def _correlated_field(rng: np.random.Generator, model: SensorModel) -> Map:
    """Noise of unit variance: white noise plus correlated parts."""
    size = (HEIGHT_PX + _MARGIN_PX, WIDTH_PX + _MARGIN_PX)
    total = np.zeros(size, np.float32)
    for share, blur_px in model.noise_parts:
        field = rng.standard_normal(size, dtype=np.float32)
        field = blur(field, blur_px) if blur_px else field
        total += field * np.float32(np.sqrt(share) / field.std())
    return total
