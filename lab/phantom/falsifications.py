"""Things in view that are not the patient's breathing: what a measurement of the surface may be misled by.

A falsification begins at a time of an otherwise honest recording. The truth stays that of the patient.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from engine.core.frames import ColorImage, DepthImage, FloatArray
from lab.phantom.anatomy import TRUNK_HALF_MM, Anatomy
from lab.phantom.body import Map
from lab.phantom.scenarios import Pose

Grid = npt.NDArray[np.float64]
SHEET_RGB = (62.0, 112.0, 98.0)
BLACK_RGB = (6.0, 6.0, 7.0)
STICKER_CLEAR_MM = 22.0
"""A sheet is cut out around stickers that stay visible, to this distance from their centre."""
APPEAR_S = 0.1
"""Time in which a sheet of unlimited speed, or a change below a blind area, appears."""


class Part(StrEnum):
    """The part of the region that a cover reaches in the end."""

    SIDE = "side"
    HALF = "half"
    WHOLE = "whole"


@dataclass(frozen=True, slots=True, kw_only=True)
class Cover:
    """A sheet or drape on the skin, which moves with it.

    Attributes
    ----------
    height_mm
        Height over the skin.
    part
        Its end: left of the midline, inferior to the middle, or the whole region.
    edge_mm
        Width of its edge, over which the height rises; 1 is sharp.
    speed_mm_s
        Speed at which it is drawn over the region; None for one that is laid down.
    has_color
        Whether it has a colour of its own; otherwise that of the skin below.
    rgb
        That colour.
    laid_s
        How long one that is laid down takes to reach its height: long for cloth that swells, or a belly that fills.
    follows
        Share of the skin's motion below it that it makes: a blanket bridges hollows.
    darkens
        How much darker the skin or shirt is in the end, 0 to 1: cloth that soaks. Its height may be negative then.
    """

    height_mm: float
    part: Part = Part.HALF
    edge_mm: float = 1.0
    speed_mm_s: float | None = None
    has_color: bool = True
    rgb: tuple[float, float, float] = SHEET_RGB
    laid_s: float = APPEAR_S
    follows: float = 1.0
    darkens: float = 0.0

    def way_mm(self, anatomy: Anatomy) -> float:
        """Return how far it is drawn until it lies."""
        left_mm, bottom_mm = anatomy.anchors_mm.max(axis=0).tolist()
        ways = {Part.SIDE: left_mm + self.edge_mm, Part.HALF: bottom_mm + self.edge_mm}
        return float(ways.get(self.part, 2.0 * TRUNK_HALF_MM[1]))

    def drawn_s(self, anatomy: Anatomy) -> float:
        """Return how long it takes until it lies."""
        return self.laid_s if self.speed_mm_s is None else self.way_mm(anatomy) / self.speed_mm_s

    def on(self, anatomy: Anatomy, elapsed_s: float) -> Map:
        """Return its height over the trunk's box after ``elapsed_s``, shape (593, 473)."""
        return np.asarray(self.height_mm * self.share(anatomy, elapsed_s), dtype=np.float32)

    def share(self, anatomy: Anatomy, elapsed_s: float) -> Map:
        """Return the share of its height that it has over the trunk's box after ``elapsed_s``, shape (593, 473)."""
        x_mm, y_mm = _trunk_grid()
        anchors, way_mm = anatomy.anchors_mm, self.way_mm(anatomy)
        # Distance inside the edge where it lies in the end.
        inside_mm = {Part.SIDE: x_mm, Part.HALF: y_mm}.get(self.part, y_mm + TRUNK_HALF_MM[1])
        share = float(np.clip(elapsed_s / self.drawn_s(anatomy), 0.0, 1.0))
        if self.speed_mm_s is None:
            height = share * _rise(inside_mm / self.edge_mm)
        else:
            height = _rise((inside_mm - (1.0 - share) * way_mm) / self.edge_mm)
        for x, y in anchors:
            height = height * _rise((np.hypot(x_mm - x, y_mm - y) - STICKER_CLEAR_MM) / 4.0)
        return np.asarray(height, dtype=np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class Limb:
    """An arm that comes in from the patient's left and lies across the body, or a person who leans into the view.

    Attributes
    ----------
    y_mm
        Where it lies, inferior to the middle of the chest.
    reach_mm
        How far its end is from the midline, to the patient's left; negative is beyond it.
    over_mm
        Height of its middle over the highest skin.
    radius_mm
        Half of its width.
    follows
        Share of the breath, at the middle of the region, that it moves up and down with: 1 for an arm on the belly.
    """

    y_mm: float
    reach_mm: float
    over_mm: float = 50.0
    radius_mm: float = 42.0
    follows: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MovedMarker:
    """A sticker that is hidden for a while, and is back elsewhere or higher.

    Attributes
    ----------
    marker
        0 to 3: superior right, superior left, inferior left, inferior right.
    outward_mm
        How far from the middle of the four it is then; negative is inward.
    up_mm
        How far over the skin it is then, as on a sheet.
    away_s
        How long it is hidden.
    """

    marker: int
    outward_mm: float = 0.0
    up_mm: float = 0.0
    away_s: float = 0.7

    def anchors(self, anchors_mm: Grid) -> Grid:
        """Return the stickers' places with this one moved (x, y, z down) [mm], shape (4, 3)."""
        moved = np.array(anchors_mm, dtype=np.float64)
        out = moved[self.marker, :2] - moved[:, :2].mean(axis=0)
        moved[self.marker, :2] += self.outward_mm * out / np.hypot(*out)
        moved[self.marker, 2] -= self.up_mm
        return moved


@dataclass(frozen=True, slots=True, kw_only=True)
class Blind:
    """An area without depth readings, below which the skin changes.

    Attributes
    ----------
    first, last
        Superior and inferior end of the area as shares of the region's length: 0 superior, 1 inferior.
    raised_mm
        How far the skin rises there.
    """

    first: float
    last: float
    raised_mm: float = 0.0

    def inside(self, anatomy: Anatomy, y_mm: FloatArray) -> FloatArray:
        """Return the share of the rise at rows of the skin, 0 to 1: 1 in the area, falling to 0 within 20 mm."""
        top, bottom = (float(anatomy.anchors_mm[rows, 1].mean()) for rows in ([0, 1], [2, 3]))
        first, last = top + self.first * (bottom - top), top + self.last * (bottom - top)
        return np.asarray(_rise((y_mm - first) / 20.0 + 1.0) * _rise((last - y_mm) / 20.0 + 1.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Rolling:
    """Stripes across the region without depth readings, another one in each frame: a beat with other infrared light.

    Attributes
    ----------
    stripes
        Into how many the region is divided; one of them is hidden.
    fps
        Frames a second.
    """

    stripes: int = 6
    fps: float = 30.0

    def inside(self, anatomy: Anatomy, y_mm: FloatArray, time_s: float) -> npt.NDArray[np.bool_]:
        """Return which rows of the skin are hidden at this time."""
        top, bottom = (float(anatomy.anchors_mm[rows, 1].mean()) for rows in ([0, 1], [2, 3]))
        stripe = np.floor((y_mm - top) / (bottom - top) * self.stripes)
        return np.asarray(stripe == round(time_s * self.fps) % self.stripes)


@dataclass(frozen=True, slots=True, kw_only=True)
class Move:
    """A rigid move within ``over_s``: of the body, or of all that the camera sees, as when the camera itself moves.

    Attributes
    ----------
    x_mm, y_mm, up_mm
        To the patient's left, inferior, towards the camera.
    turn_deg, tilt_deg, roll_deg
        About the vertical, about the axis across the body, about the body's long axis.
    """

    x_mm: float = 0.0
    y_mm: float = 0.0
    up_mm: float = 0.0
    turn_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    over_s: float = 0.3
    steps: int = 12

    def pose(self, elapsed_s: float) -> Pose:
        """Return the pose after ``elapsed_s``; it changes in ``steps``, since every pose costs a second to prepare."""
        share = round(float(np.clip(elapsed_s / self.over_s, 0.0, 1.0)) * self.steps) / self.steps
        turn, tilt, roll = np.deg2rad([self.turn_deg, self.tilt_deg, self.roll_deg]).tolist()
        return Pose(
            x_mm=share * self.x_mm,
            y_mm=share * self.y_mm,
            z_mm=-share * self.up_mm,
            turn_rad=share * turn,
            tilt_rad=share * tilt,
            roll_rad=share * roll,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Stale:
    """Pictures that are old, wholly or in part, with new times.

    Attributes
    ----------
    ring
        Number of old pictures that come in turn; 1 is a frozen picture.
    flicker
        Share of the pixels that change by a step of the sensor in each picture, 0 to 1.
    delay_s_per_s
        How much older the pictures become each second; 0 for a ring.
    torn_frames
        How many frames old the lower half of both pictures is, as where a transfer mixes two buffers; 0 for a ring.
    averaged_frames
        Over how many frames the driver averages the depth, as a filter in time does; 0 for a ring.
    """

    ring: int = 1
    flicker: float = 0.0
    delay_s_per_s: float = 0.0
    torn_frames: int = 0
    averaged_frames: int = 0

    @property
    def is_of_moving(self) -> bool:
        """Whether the old pictures are always the latest ones before, not the same ones again."""
        return bool(self.delay_s_per_s or self.torn_frames or self.averaged_frames)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFault:
    """What a camera or its driver does to its own pictures.

    Attributes
    ----------
    scale
        Factor of all depths, at once.
    warms_mm, warms_s
        How far all depths drift, and within which time: a sensor that warms up.
    is_mirrored
        Whether both pictures are mirrored: a setting of the driver.
    clips_mm
        Least depth that is delivered, counted from the camera's distance to the chest: what is nearer reads as this
        one, as where light or the sensor's range end. None for none.
    """

    scale: float = 1.0
    warms_mm: float = 0.0
    warms_s: float = 60.0
    is_mirrored: bool = False
    clips_mm: float | None = None

    def depth(self, depth_mm: DepthImage, elapsed_s: float, chest_mm: float) -> DepthImage:
        """Return the depth picture as it is delivered, shape (H, W); no reading stays none.

        ``chest_mm`` is the camera's distance to the chest at rest.
        """
        drift_mm = self.warms_mm * float(np.clip(elapsed_s / self.warms_s, 0.0, 1.0))
        changed = np.rint(depth_mm * self.scale + drift_mm)
        if self.clips_mm is not None:
            changed = np.maximum(changed, np.rint(chest_mm + self.clips_mm))
        changed = changed.astype(depth_mm.dtype)
        changed[depth_mm == 0] = 0
        return np.ascontiguousarray(changed[:, ::-1] if self.is_mirrored else changed)

    def color(self, picture: ColorImage) -> ColorImage:
        """Return the colour picture as it is delivered, shape (H, W, 3)."""
        return np.ascontiguousarray(picture[:, ::-1]) if self.is_mirrored else picture


@dataclass(frozen=True, slots=True, kw_only=True)
class Falsification:
    """What is not honest about a recording from ``start_s`` on; several parts may come together.

    ``slide_mm`` is how far all stickers slide along the body with each inhale, as on clothing. ``scene_seen_s`` is how
    long before ``start_s`` couch and floor are uncovered; None where they always are. ``floor_stays`` turns the
    camera's move into one of the couch, with the patient on it.
    """

    start_s: float
    cover: Cover | None = None
    marker: MovedMarker | None = None
    blind: Blind | None = None
    body: Move | None = None
    camera: Move | None = None
    stale: Stale | None = None
    hides_marker_s: float = 0.0
    rolling: Rolling | None = None
    slide_mm: float = 0.0
    scene_seen_s: float | None = None
    floor_stays: bool = False
    fault: CameraFault | None = None
    limb: Limb | None = None

    def elapsed_s(self, time_s: float) -> float | None:
        """Time since it began; None before."""
        return time_s - self.start_s if time_s >= self.start_s else None

    def hides_scene(self, time_s: float) -> bool:
        """Whether couch and floor are covered at this time."""
        return self.scene_seen_s is not None and time_s < self.start_s - self.scene_seen_s

    def hidden_marker(self, time_s: float) -> int | None:
        """Return the sticker that is hidden under a cloth at this time, if any."""
        elapsed_s = self.elapsed_s(time_s)
        if elapsed_s is None:
            return None
        if self.marker is not None and elapsed_s < self.marker.away_s:
            return self.marker.marker
        return 2 if elapsed_s < self.hides_marker_s else None


def _trunk_grid() -> tuple[FloatArray, FloatArray]:
    half_x, half_y = TRUNK_HALF_MM
    x_mm, y_mm = np.meshgrid(np.arange(-half_x, half_x + 0.5), np.arange(-half_y, half_y + 0.5))
    return x_mm, y_mm


def _rise(t: FloatArray) -> FloatArray:
    """From 0 at t = 0 to 1 at t = 1, flat at both ends."""
    clipped = np.clip(t, 0.0, 1.0)
    return np.asarray(clipped * clipped * (3.0 - 2.0 * clipped))
