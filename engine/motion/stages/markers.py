"""Finds the four dot markers in a colour picture to 0.1 px (article, section 4.2).

The article thresholds the whole picture with Otsu's method, which fails on a bright bed, skin, lamps and reflections.
Here a white top-hat first removes structures larger than a sticker, and Otsu's threshold separates the rest. Candidates
must have the sticker's size at the distance that the depth camera measures, be round and white, and have a darker
surrounding ring. Four of them must form a quadrilateral that can bound a torso. Found markers are tracked in small
windows.

Coordinates are colour pixels, x right and y down, pixel centres at integers.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.compiled import FramePath
from engine.core.frames import BoolArray, ColorImage, FloatArray, Lost, LostReason, Markers
from engine.core.sentences import listed, say

MAX_CANDIDATES = 14
UP_PX = (0.0, -1.0)
LEFT_PX = (-1.0, 0.0)
ACROSS = 1.15  # largest ratio of width to length for a patient who lies along the picture's columns
MIN_ASPECT = 0.4  # a sticker on a slope of 66 degrees
MIN_FILL, MAX_FILL = 0.85, 1.15
# Radii of the disc that is certainly sticker and of the ring that certainly is not, in sticker radii.
DISC_RADII = 0.5
RING_RADII = (1.55, 2.1)
MAX_BRIGHT_RING = 0.12
RADIUS_STEP_PX = 0.1
# For a smaller sticker the ring has no pixels and the disc less than one.
CORNERS = (say("superior right"), say("superior left"), say("inferior left"), say("inferior right"))
"""The markers in their order, by the patient's sides."""
SMALLEST_PX = 3.2
# Four stickers four diameters apart, with their rings, need a picture six diameters high.
LARGEST_SHARE = 1.0 / 6.0
STENCILS_KEPT = 16
MAX_STEPS = 4
# Largest offset of a patch from the sticker's centre at which the iteration stops.
CONVERGED_PX = 0.6
GrayImage = npt.NDArray[np.uint8]
IndexArray = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True, kw_only=True)
class MarkerSearch:
    """Expected appearance of a marker, and orientation of the patient.

    Attributes
    ----------
    diameter_px
        Expected diameter of a sticker in the picture [px].
    diameter_tolerance
        Largest accepted ratio of measured and expected diameter, in both directions.
    min_contrast
        Least brightness difference between the sticker and the ring around it [grey levels].
    max_background_share
        Largest brightness of the ring as a share of the sticker's; it excludes white spots on a bright bed.
    superior_px
        Direction towards the patient's head in the picture (x, y). None: the top of the picture, or its left if the
        quadrilateral is wider than long.
    """

    diameter_px: float
    diameter_tolerance: float = 1.6
    min_contrast: float = 30.0
    max_background_share: float = 0.7
    superior_px: tuple[float, float] | None = None


class _Blob(NamedTuple):
    center_px: tuple[float, float]
    score: float
    diameter_px: float


def find_markers(color: ColorImage, search: MarkerSearch) -> Markers | Lost:
    """Search the whole picture for the four markers.

    Returns
    -------
    Markers | Lost
        Ordered by geometry (superior right first, clockwise as seen by the camera), or why they were not found.
    """
    refused = refuse_size(color, search)
    if refused is not None:
        return refused
    blobs = _find_blobs(color, search)
    quadrilateral = _best_quadrilateral(blobs, search)
    if quadrilateral is None:
        detail = (
            say("{blobs} of 4 markers found", blobs=len(blobs))
            if len(blobs) < 4
            else say("no four of the spots found form a valid quadrilateral")
        )
        return Lost(reason=LostReason.MARKER_LOST, detail=detail)
    return Markers(centers_px=quadrilateral)


def find_stickers(color: ColorImage, search: MarkerSearch) -> FloatArray:
    """Search the whole picture for all sticker candidates.

    Returns
    -------
    FloatArray
        Centres [px], best first, shape (n, 2), n up to 14; those of the four markers are among them.
    """
    blobs = [] if refuse_size(color, search) is not None else _find_blobs(color, search)
    return np.array([blob.center_px for blob in blobs]).reshape(-1, 2)


def refuse_size(color: ColorImage, search: MarkerSearch) -> Lost | None:
    """Return the reason if the expected marker size is out of range for this picture, otherwise None."""
    largest_px = LARGEST_SHARE * min(color.shape[:2])
    if SMALLEST_PX <= search.diameter_px <= largest_px:
        return None
    detail = say(
        "markers would be {diameter_px:.1f} px wide; {smallest_px:g} to {largest_px:.0f} px can be found",
        diameter_px=search.diameter_px,
        smallest_px=SMALLEST_PX,
        largest_px=largest_px,
    )
    return Lost(reason=LostReason.MARKER_LOST, detail=detail)


def _find_blobs(color: ColorImage, search: MarkerSearch) -> list[_Blob]:
    candidates = _candidate_centers(_whiteness(color), search)
    found, is_found = _refine(color, candidates, search)
    blobs = [_blob_of(moments, search) for moments in found[is_found].tolist()]
    return sorted(_distinct(blobs), key=lambda blob: -blob.score)[:MAX_CANDIDATES]


def track_markers(color: ColorImage, expected_px: FloatArray, search: MarkerSearch) -> Markers | Lost:
    """Search each marker near its expected position, shape (4, 2) [px]; the order is kept.

    A loss names the markers that are not there, by their corner of the region.
    """
    refused = refuse_size(color, search)
    if refused is not None:
        return refused
    moments, is_found = _refine(color, expected_px, search)
    are_there = is_found.tolist()
    if False in are_there:
        missing = [corner for corner, is_there in zip(CORNERS, are_there, strict=True) if not is_there]
        where = say("no marker is near its last position") if len(missing) == len(CORNERS) else missing_text(missing)
        return Lost(reason=LostReason.MARKER_LOST, detail=where)
    found = moments[:, 6:].copy()
    if not _bounds_a_region(found, search.diameter_px**2):
        return Lost(reason=LostReason.MARKER_LOST, detail=say("the tracked markers do not form a valid quadrilateral"))
    return Markers(centers_px=found)


def missing_text(corners: Sequence[str]) -> str:
    """Name the markers that are not seen."""
    if len(corners) == 1:
        return say("the {corner} marker is hidden or gone", corner=corners[0])
    return say("markers hidden or gone: {corners}", corners=listed(", ", corners))


def _bounds_a_region(centers_px: FloatArray, least_px2: float) -> bool:
    """Whether four centres form a convex, clockwise quadrilateral; collinear or merged ones do not."""
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = centers_px.tolist()
    ax, ay, bx, by, cx, cy, dx, dy = x1 - x0, y1 - y0, x2 - x1, y2 - y1, x3 - x2, y3 - y2, x0 - x3, y0 - y3
    return bool(min(ax * by - ay * bx, bx * cy - by * cx, cx * dy - cy * dx, dx * ay - dy * ax) > least_px2)


def order_by_geometry(centers_px: FloatArray, superior_px: tuple[float, float]) -> FloatArray:
    """Order four centres: superior right, superior left, inferior left, inferior right (the patient's sides).

    For a supine patient seen from above with the head at the top of the picture, the patient's right is on the left.
    """
    superior = np.asarray(superior_px, dtype=np.float64) / np.hypot(*superior_px)
    left = np.array([-superior[1], superior[0]])
    offsets = centers_px - centers_px.mean(axis=0)
    by_height = np.argsort(-(offsets @ superior), kind="stable")
    upper = sorted(by_height[:2], key=lambda i: offsets[i] @ left)
    lower = sorted(by_height[2:], key=lambda i: -(offsets[i] @ left))
    return np.ascontiguousarray(centers_px[[*upper, *lower]], dtype=np.float64)


def _ordered(centers_px: FloatArray, superior_px: tuple[float, float] | None) -> FloatArray:
    if superior_px is not None:
        return order_by_geometry(centers_px, superior_px)
    corners = order_by_geometry(centers_px, UP_PX)
    width, length = _width_and_length(corners)
    return corners if width <= ACROSS * length else order_by_geometry(centers_px, LEFT_PX)


def _width_and_length(corners: FloatArray) -> tuple[float, float]:
    top, left, bottom, right = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    return 0.5 * float(top + bottom), 0.5 * float(left + right)


def layout_change(centers_px: FloatArray, reference_px: FloatArray) -> float:
    """Return the largest relative change of the six distances between markers from a reference layout; NaN of NaN."""
    largest = 0.0
    for (now, then), (other_now, other) in itertools.combinations(
        zip(centers_px.tolist(), reference_px.tolist(), strict=True), 2
    ):
        change = abs(math.dist(now, other_now) / math.dist(then, other) - 1.0)
        if not change <= largest:
            largest = change
            if math.isnan(change):
                break
    return largest


def _whiteness(color: ColorImage) -> GrayImage:
    """Brightness of the darkest channel: white is bright in all three, skin and coloured lamps are not."""
    return np.minimum(np.minimum(color[..., 0], color[..., 1]), color[..., 2])


def _candidate_centers(gray: GrayImage, search: MarkerSearch) -> FloatArray:
    size = int(np.ceil(search.diameter_px * search.diameter_tolerance)) | 1
    smooth = cv2.GaussianBlur(gray, (3, 3), 0)
    opened = cv2.morphologyEx(smooth, cv2.MORPH_OPEN, np.ones((size, size), np.uint8))
    hat = cv2.subtract(smooth, opened)
    strong = hat[hat > search.min_contrast / 2]
    if strong.size == 0:
        return np.empty((0, 2))
    threshold, _ = cv2.threshold(
        np.ascontiguousarray(strong).reshape(1, -1), 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU
    )
    # Illumination is uneven: Otsu's level suits the brightest sticker; half of it also finds the darkest.
    level = max(search.min_contrast * 0.6, 0.5 * float(threshold))
    count, _, stats, centroids = cv2.connectedComponentsWithStats((hat > level).astype(np.uint8), connectivity=4)
    sides = stats[1:count, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]
    low, high = search.diameter_px / search.diameter_tolerance, search.diameter_px * search.diameter_tolerance * 1.3
    fits = (sides >= 0.5 * low).all(axis=1) & (sides <= high).all(axis=1)
    return np.asarray(centroids[1:count][fits])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Stencil:
    """Pixel indices and weights of a flattened square patch around a marker.

    Attributes
    ----------
    reach
        Distance from the middle of the patch to its edge [px].
    ring, disc
        Indices of the background pixels and of the marker pixels.
    moments
        1, x, y, x^2, x y, y^2 of each pixel relative to the middle, zero beyond the ring, shape (pixels, 6).
    """

    reach: int
    ring: IndexArray
    disc: IndexArray
    moments: FloatArray


@lru_cache(maxsize=STENCILS_KEPT)
def _stencil(radius_steps: int) -> _Stencil:
    radius = radius_steps * RADIUS_STEP_PX
    reach = int(np.ceil(RING_RADII[1] * radius))
    x, y = (part.ravel().astype(np.float64) for part in np.mgrid[-reach : reach + 1, -reach : reach + 1][::-1])
    distance = np.hypot(x, y) / radius
    is_within = distance <= RING_RADII[1]
    return _Stencil(
        reach=reach,
        # Every second pixel, in a checkerboard pattern, is enough.
        ring=np.flatnonzero((distance > RING_RADII[0]) & is_within & ((x + y) % 2 == 0)),
        disc=np.flatnonzero(distance <= DISC_RADII),
        moments=(np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y]) * is_within[:, None]).astype(np.float32),
    )


def _refine(color: ColorImage, starts_px: FloatArray, search: MarkerSearch) -> tuple[FloatArray, BoolArray]:
    """Iterate to the centre of the sticker near each start, shape (N, 2) [px], and validate it.

    Returns
    -------
    tuple[FloatArray, BoolArray]
        Total, mean x, y and central second moments xx, xy, yy of each sticker, then its centre x, y [px], shape (N, 8);
        and whether there is one.
    """
    stencil = _stencil(round(0.5 * search.diameter_px / RADIUS_STEP_PX))
    starts_px = np.ascontiguousarray(starts_px, dtype=np.float64).reshape(-1, 2)
    compiled = FramePath.kernels
    if compiled is None:
        return _refine_together(color, starts_px, stencil, search)
    found, is_found = np.empty((len(starts_px), 8)), np.empty(len(starts_px), dtype=np.bool_)
    compiled.refine_markers(
        np.ascontiguousarray(color),
        starts_px,
        stencil.reach,
        stencil.ring,
        stencil.disc,
        stencil.moments,
        search.min_contrast,
        search.max_background_share,
        MAX_BRIGHT_RING * len(stencil.ring),
        MAX_STEPS,
        CONVERGED_PX,
        search.diameter_px,
        search.diameter_tolerance,
        MIN_ASPECT,
        MIN_FILL,
        MAX_FILL,
        found,
        is_found,
    )
    return found, is_found


def _refine_together(
    color: ColorImage, starts_px: FloatArray, stencil: _Stencil, search: MarkerSearch
) -> tuple[FloatArray, BoolArray]:
    """Iterate with numpy, all stickers at once."""
    centers = starts_px
    middles = np.rint(centers)
    found, is_found = np.zeros((len(centers), 8)), np.zeros(len(centers), dtype=np.bool_)
    pending = np.arange(len(centers))
    for _ in range(MAX_STEPS):
        pending = pending[_is_inside(middles[pending], stencil.reach, color.shape)]
        if not pending.size:
            break
        patches = _patches(color, middles[pending], stencil.reach)
        moments, is_marked = _moments(patches, stencil, search)
        pending, moments = pending[is_marked], moments[is_marked]
        centers = middles[pending] + moments[:, 1:3]
        has_converged = np.abs(moments[:, 1:3]).max(axis=1, initial=0.0) <= CONVERGED_PX
        for index in np.flatnonzero(has_converged):
            found[pending[index]] = [*moments[index].tolist(), *centers[index].tolist()]
            is_found[pending[index]] = _is_disc(found[pending[index]].tolist(), search)
        middles[pending] = np.rint(centers)
        pending = pending[~has_converged]
    return found, is_found


def _is_inside(middles: FloatArray, reach: int, shape: tuple[int, ...]) -> BoolArray:
    low = middles.min(axis=1) >= reach
    return np.asarray(low & (middles[:, 0] < shape[1] - reach) & (middles[:, 1] < shape[0] - reach))


def _patches(color: ColorImage, middles: FloatArray, reach: int) -> FloatArray:
    """Cut out the whiteness around each middle, shape (N, pixels), float32."""
    corners = (middles - reach).astype(int).tolist()
    side = 2 * reach + 1
    windows = np.array([color[top : top + side, left : left + side] for left, top in corners])
    return _whiteness(windows).reshape(len(corners), -1).astype(np.float32)


def _moments(patches: FloatArray, stencil: _Stencil, search: MarkerSearch) -> tuple[FloatArray, BoolArray]:
    """Return total, mean x, y and central second moments xx, xy, yy of each sticker, and whether there is one.

    Each pixel is weighted by the share of it covered by the sticker, estimated from its brightness between ring and
    disc.
    """
    ring = patches[:, stencil.ring]
    background, foreground = _upper_median(ring), _upper_median(patches[:, stencil.disc])
    contrast = foreground - background
    # The ring must be darker on all sides, which excludes spots next to a bright bed or skin.
    bright = np.count_nonzero(ring > (0.5 * (background + foreground))[:, None], axis=1)
    is_marked = (
        (contrast >= search.min_contrast)
        & (background <= search.max_background_share * foreground)
        & (bright <= MAX_BRIGHT_RING * ring.shape[1])
    )
    gain = 2.0 / np.maximum(contrast, 1.0)
    weights = patches * gain[:, None]
    weights -= (background * gain + 0.5)[:, None]
    sums = (np.minimum(np.maximum(weights, 0.0, out=weights), 1.0, out=weights) @ stencil.moments).astype(np.float64)
    total = sums[:, :1]
    is_marked &= total[:, 0] > 0.0
    sums[:, 1:] /= np.maximum(total, 1e-9)
    sums[:, 3:] -= sums[:, [1, 1, 2]] * sums[:, [1, 2, 2]]
    return sums, is_marked


def _upper_median(values: FloatArray) -> FloatArray:
    """Return the upper median of each row; ten times as fast as `np.median` on a hundred values."""
    half = values.shape[1] // 2
    return np.asarray(np.partition(values, half, axis=1)[:, half])


def _axes_px(moments: list[float]) -> tuple[float, float]:
    """Return the axes of an ellipse by its second moments: a uniform disc of diameter D has the variance D^2 / 16."""
    _, _, _, xx, xy, yy, _, _ = moments
    mean, half_spread = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    return 4.0 * math.sqrt(max(mean - half_spread, 1e-9)), 4.0 * math.sqrt(max(mean + half_spread, 1e-9))


def _is_disc(moments: list[float], search: MarkerSearch) -> bool:
    """Whether size and roundness are a sticker's."""
    minor, major = _axes_px(moments)
    # A sticker on a slope is foreshortened across it and keeps its diameter along it.
    ratio = major / search.diameter_px
    fill = moments[0] / (0.25 * math.pi * minor * major)  # 1 for a filled ellipse, less for a ring or a ragged patch
    is_round = minor / major >= MIN_ASPECT and MIN_FILL <= fill <= MAX_FILL
    return 1.0 / search.diameter_tolerance <= ratio <= search.diameter_tolerance and is_round


def _blob_of(moments: list[float], search: MarkerSearch) -> _Blob:
    """Return the sticker with these moments."""
    _, diameter_px = _axes_px(moments)
    score = 1.0 - abs(math.log(diameter_px / search.diameter_px))
    return _Blob(center_px=(moments[6], moments[7]), score=score, diameter_px=diameter_px)


def _distinct(blobs: list[_Blob]) -> list[_Blob]:
    """Keep the first of several blobs within a radius of each other; a dotted cloth gives thousands."""
    centers_px = np.array([blob.center_px for blob in blobs]).reshape(-1, 2)
    is_kept = np.zeros(len(blobs), dtype=np.bool_)
    for index, blob in enumerate(blobs):
        offsets_px = centers_px[:index][is_kept[:index]] - centers_px[index]
        is_kept[index] = (np.hypot(offsets_px[:, 0], offsets_px[:, 1]) > 0.5 * blob.diameter_px).all()
    return list(itertools.compress(blobs, is_kept.tolist()))


def _best_quadrilateral(blobs: list[_Blob], search: MarkerSearch) -> FloatArray | None:
    """Choose the four that best bound the torso: convex, longer than wide, opposite sides alike, large."""
    best: tuple[float, FloatArray] | None = None
    for four in itertools.combinations(blobs, 4):
        corners = _ordered(np.array([blob.center_px for blob in four]), search.superior_px)
        score = _layout_score(corners, search) + 0.3 * sum(blob.score for blob in four)
        if np.isfinite(score) and (best is None or score > best[0]):
            best = (score, corners)
    return None if best is None else best[1]


def _layout_score(corners: FloatArray, search: MarkerSearch) -> float:
    sides = np.roll(corners, -1, axis=0) - corners
    turns = sides[:, 0] * np.roll(sides[:, 1], -1) - sides[:, 1] * np.roll(sides[:, 0], -1)
    top, left, bottom, right = np.linalg.norm(sides, axis=1)
    if (turns <= 0.0).any() or min(top, left, bottom, right) < 4.0 * search.diameter_px:
        return float("-inf")
    width, length = _width_and_length(corners)
    diagonals = np.linalg.norm(corners[0] - corners[2]), np.linalg.norm(corners[1] - corners[3])
    uneven = (
        abs(np.log(top / bottom)) + 2.0 * abs(np.log(left / right)) + 2.0 * abs(np.log(diagonals[0] / diagonals[1]))
    )
    if not 0.6 <= length / width <= 4.0 or uneven > 1.2:
        return float("-inf")
    return float(0.5 * np.log(width * length / search.diameter_px**2) - 2.0 * uneven)
