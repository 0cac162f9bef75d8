"""The volunteer's body as a height over the couch, and the fields of its breathing motion.

Body frame, mm: x to the patient's left, y inferior, h up from the couch; the origin is under the middle of the four
stickers. A point of the skin keeps its (x, y) and moves in h only: ``h(x, y, t) = h0(x, y) + sum_k a_k(t) m_k(x, y)``.
Eight fields m_k: abdomen and thorax, each split into three parts that follow the same signal with different delays, so
that the phase varies smoothly over the skin; folds of the shirt, which deepen with the breath nonlinearly; and the
heart. The motion therefore needs more than three components.

The formulas here are sampled once; pictures read the samples linearly (1 mm apart), truth by cubic splines (2 mm).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from engine.core.frames import FloatArray
from lab.phantom.builds import BUILDS, NO_DEPARTURE, Build, Departure, find_build

MODES = 8
STICKER_RADIUS_MM = 10.0
# Half extents in x and y: of the moving skin, and of the sampled body with a margin.
TRUNK_HALF_MM = (236.0, 296.0)
BODY_HALF_MM = (330.0, 500.0)
TOP_MM, BOTTOM_MM = -255.0, 310.0

_HEIGHT_Y_MM = (-300.0, -255.0, -215.0, -170.0, -100.0, -30.0, 40.0, 110.0, 180.0, 240.0, 310.0, 360.0)
_CHEST_SHARE = (0.62, 0.76, 0.88, 0.96, 1.0, 0.97, 0.72, 0.45, 0.30, 0.35, 0.45, 0.45)
_BELLY_SHARE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.03, 0.28, 0.55, 0.66, 0.55, 0.37, 0.33)
_WIDTH_SHARE = (0.42, 0.66, 1.02, 1.10, 1.03, 0.97, 0.94, 0.96, 1.03, 1.08, 1.05, 1.0)

Grid = npt.NDArray[np.float64]
__all__ = ["BUILDS", "MODES", "Anatomy", "Spot"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Ridge:
    """A crease of the shirt: a short train of waves on the skin."""

    x_mm: float
    y_mm: float
    length_mm: float
    width_mm: float
    angle_rad: float
    wave_mm: float
    height_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Spot:
    """A round area of the body: a sticker, a shiny patch, a button."""

    x_mm: float
    y_mm: float
    radius_mm: float


class Anatomy:
    """One volunteer's body; independent of the seed."""

    def __init__(self, volunteer: int, departure: Departure = NO_DEPARTURE) -> None:
        self.build: Build = departure.of(find_build(volunteer))
        rng = np.random.default_rng((20_171_840, volunteer))
        self.ridges = tuple(_ridge(rng) for _ in range(9))
        self.folds = tuple(_ridge(rng) for _ in range(6))
        self.stickers = _stickers(self.build, rng)
        self.shiny = tuple(_shiny(rng) for _ in range(3))
        self.button = Spot(x_mm=float(rng.uniform(-6, 6)), y_mm=float(rng.uniform(-80, -40)), radius_mm=5.5)
        level = np.array(_CHEST_SHARE) * self.build.chest_mm + np.array(_BELLY_SHARE) * self.build.belly_base_mm
        self._level = CubicSpline(_HEIGHT_Y_MM, level)
        self._half_width = CubicSpline(_HEIGHT_Y_MM, np.array(_WIDTH_SHARE) * self.build.half_width_mm)

    @property
    def anchors_mm(self) -> Grid:
        """Sticker centres (x, y) [mm], shape (4, 2): superior right, superior left, inferior left, inferior right."""
        return np.array([(spot.x_mm, spot.y_mm) for spot in self.stickers])

    def side(self, x_mm: FloatArray, y_mm: FloatArray) -> Grid:
        """Lateral position of a point: 0 on the midline, 1 at the side of the trunk."""
        return np.abs(x_mm) / self._half_width(np.clip(y_mm, -300.0, 360.0))

    def trunk_height(self, x_mm: FloatArray, y_mm: FloatArray) -> Grid:
        """Height of the resting trunk over the couch [mm], shirt creases included; smooth everywhere."""
        y_in = np.clip(y_mm, -300.0, 360.0)
        r2 = (x_mm / self._half_width(y_in)) ** 2
        build = self.build
        height = self._level(y_in) * (1.0 - 0.14 * r2 - 0.42 * np.minimum(r2, 1.3) ** 2)
        right, left = 1.0 + build.asymmetry, 1.0 - build.asymmetry
        half = 0.45 * build.half_width_mm
        height += build.breast_mm * right * _bump(x_mm, y_mm, -half, -95.0, 42.0, 48.0)
        height += build.breast_mm * left * _bump(x_mm, y_mm, half, -95.0, 42.0, 48.0)
        height -= 4.0 * _bump(x_mm, y_mm, 0.0, -80.0, 12.0, 70.0)  # breastbone
        height -= 5.0 * _bump(x_mm, y_mm, 0.0, 5.0, 55.0, 18.0)  # edge of the ribs
        height += build.belly_mm * _bump(x_mm, y_mm, 4.0, 90.0, 95.0, 75.0)
        height -= 3.0 * _bump(x_mm, y_mm, 2.0, 118.0, 10.0, 9.0)  # navel, under the shirt
        return np.asarray(height + self.creases(x_mm, y_mm))

    def creases(self, x_mm: FloatArray, y_mm: FloatArray) -> Grid:
        """Height of the shirt's creases alone [mm]."""
        return _sum_ridges(self.ridges, x_mm, y_mm)

    def modes(self, x_mm: FloatArray, y_mm: FloatArray) -> Grid:
        """Return the fields m_k, shape (8, ...): abdomen early, middle, late; thorax the same; folds; heart.

        The three abdominal fields add up to at most about 1, and so do the thoracic ones.
        """
        edge = _fade(y_mm, -262.0, -205.0) * (1.0 - _fade(y_mm, 225.0, 285.0))
        edge = edge * (1.0 - 0.45 * np.minimum(self.side(x_mm, y_mm), 1.2) ** 2)
        edge = edge * (1.0 - _fade(np.abs(x_mm), 0.97 * TRUNK_HALF_MM[0] - 40.0, 0.97 * TRUNK_HALF_MM[0]))
        asymmetry = 1.0 - self.build.asymmetry * 2.0 * np.tanh(x_mm / 80.0)
        abdomen = edge * _bump(x_mm, y_mm, 3.0, 88.0, 150.0, 82.0)
        thorax = edge * asymmetry * _bump(x_mm, y_mm, 0.0, -105.0, 190.0, 88.0)
        late_below = 0.5 + 0.5 * np.tanh((y_mm - 90.0) / 75.0 + x_mm / 220.0)
        late_above = 0.5 + 0.5 * np.tanh((-100.0 - y_mm) / 70.0 - x_mm / 160.0)
        folds = edge * _sum_ridges(self.folds, x_mm, y_mm)
        heart = edge * _bump(x_mm, y_mm, 38.0, -55.0, 38.0, 42.0)
        return np.stack([*(abdomen * _thirds(late_below)), *(thorax * _thirds(late_above)), folds, heart])


def _sum_ridges(ridges: tuple[Ridge, ...], x_mm: FloatArray, y_mm: FloatArray) -> Grid:
    total = np.zeros(np.broadcast_shapes(np.shape(x_mm), np.shape(y_mm)))
    for ridge in ridges:
        cosine, sine = np.cos(ridge.angle_rad), np.sin(ridge.angle_rad)
        along = (x_mm - ridge.x_mm) * cosine + (y_mm - ridge.y_mm) * sine
        across = (y_mm - ridge.y_mm) * cosine - (x_mm - ridge.x_mm) * sine
        window = np.exp(-0.5 * ((along / ridge.length_mm) ** 2 + (across / ridge.width_mm) ** 2))
        total += ridge.height_mm * window * np.cos(2.0 * np.pi * across / ridge.wave_mm)
    return total


def _thirds(lateness: Grid) -> tuple[Grid, Grid, Grid]:
    """Three smooth weights that add up to one."""
    return (1.0 - lateness) ** 2, 2.0 * lateness * (1.0 - lateness), lateness**2


def _bump(x_mm: FloatArray, y_mm: FloatArray, x0: float, y0: float, sx: float, sy: float) -> Grid:
    return np.asarray(np.exp(-0.5 * (((x_mm - x0) / sx) ** 2 + ((y_mm - y0) / sy) ** 2)))


def _fade(value: FloatArray, low: float, high: float) -> Grid:
    """From 0 to 1, with two continuous derivatives."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return np.asarray(t**3 * (t * (6.0 * t - 15.0) + 10.0))


def _ridge(rng: np.random.Generator) -> Ridge:
    return Ridge(
        x_mm=float(rng.uniform(-110, 110)),
        y_mm=float(rng.uniform(-180, 190)),
        length_mm=float(rng.uniform(35, 70)),
        width_mm=float(rng.uniform(12, 24)),
        angle_rad=float(rng.uniform(-0.9, 0.9)),
        wave_mm=float(rng.uniform(22, 38)),
        height_mm=float(rng.uniform(0.6, 1.4)),
    )


def _stickers(build: Build, rng: np.random.Generator) -> tuple[Spot, ...]:
    """Stickers at the outer ends of the collar bones and at the hip bones, with placement errors of up to 4 mm."""
    top, bottom = -0.5 * build.roi_length_mm, 0.5 * build.roi_length_mm
    upper, lower = 0.56 * build.half_width_mm, 0.60 * build.half_width_mm
    places = ((-upper, top), (upper, top), (lower, bottom), (-lower, bottom))
    miss = rng.uniform(-4.0, 4.0, (4, 2))
    return tuple(
        Spot(x_mm=x + float(dx), y_mm=y + float(dy), radius_mm=STICKER_RADIUS_MM)
        for (x, y), (dx, dy) in zip(places, miss, strict=True)
    )


def _shiny(rng: np.random.Generator) -> Spot:
    return Spot(
        x_mm=float(rng.uniform(-80, 80)), y_mm=float(rng.uniform(-150, 150)), radius_mm=float(rng.uniform(6, 11))
    )
