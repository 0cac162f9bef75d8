"""Find the four dot markers in a colour picture, to a tenth of a pixel (article, section 4.2).

The article thresholds the whole picture with Otsu's method, which meets a bright bed, skin, lamps and reflections.
Here a white top-hat first removes everything larger than a sticker; Otsu then separates what is left; candidates must
have the known sticker's size at the distance the depth camera reports, be round, white and ringed by something darker;
and four of them must stand in a quadrilateral that can bound a torso. Once found they are tracked in small windows.

Coordinates are colour pixels, x right and y down, pixel centres at integers.
"""

import itertools
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from engine.frames import ColorImage, FloatArray, Lost, LostReason, Markers

MAX_CANDIDATES = 14
UP_PX = (0.0, -1.0)
LEFT_PX = (-1.0, 0.0)
ACROSS = 1.15  # so much wider than long are no markers of a patient who lies upright in the picture
MIN_ASPECT = 0.4  # a sticker on a slope of 66 degrees
GrayImage = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class MarkerSearch:
    """What a marker looks like here, and how the patient lies.

    Attributes
    ----------
    diameter_px
        Expected diameter of a sticker in the picture [px].
    diameter_tolerance
        Accepted ratio, up or down.
    min_contrast
        Least brightness step from the ring around it to the sticker [grey levels].
    max_background_share
        Largest brightness of the ring around it, as a share of the sticker's: white on a bright bed is no marker.
    superior_px
        Direction towards the patient's head in the picture (x, y). None: the top of the picture, or its left where the
        markers' longer sides lie across; a torso's markers stand further apart along it.
    """

    diameter_px: float
    diameter_tolerance: float = 1.6
    min_contrast: float = 30.0
    max_background_share: float = 0.7
    superior_px: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Blob:
    center_px: FloatArray
    score: float
    diameter_px: float


def find_markers(color: ColorImage, search: MarkerSearch) -> Markers | Lost:
    """Search the whole picture for the four markers.

    Returns
    -------
    Markers | Lost
        Ordered by geometry (superior right first, clockwise as seen by the camera), or why they were not found.
    """
    blobs = _find_blobs(color, search)
    quadrilateral = _best_quadrilateral(blobs, search)
    if quadrilateral is None:
        return Lost(reason=LostReason.MARKER_LOST, detail=f"{len(blobs)} of 4 markers found")
    return Markers(centers_px=quadrilateral)


def find_stickers(color: ColorImage, search: MarkerSearch) -> FloatArray:
    """Search the whole picture for everything that looks like a sticker.

    Returns
    -------
    FloatArray
        Centres [px], likeliest first, shape (n, 2), n up to 14; those of the four markers are among them.
    """
    return np.array([blob.center_px for blob in _find_blobs(color, search)]).reshape(-1, 2)


def _find_blobs(color: ColorImage, search: MarkerSearch) -> list[_Blob]:
    gray = color.min(axis=2)  # white is bright in all three channels; skin and coloured lamps are not
    blobs = [blob for center in _candidate_centers(gray, search) if (blob := _refine(gray, center, search)) is not None]
    return sorted(_distinct(blobs), key=lambda blob: -blob.score)[:MAX_CANDIDATES]


def track_markers(color: ColorImage, expected_px: FloatArray, search: MarkerSearch) -> Markers | Lost:
    """Look for each marker only near where it is expected, shape (4, 2); keeps the order given."""
    centers = []
    for position, expected in enumerate(expected_px):
        blob = _track_one(color, expected, search)
        if blob is None:
            return Lost(reason=LostReason.MARKER_LOST, detail=f"marker {position + 1} of 4 is not where it was")
        centers.append(blob.center_px)
    return Markers(centers_px=np.array(centers))


def order_by_geometry(centers_px: FloatArray, superior_px: tuple[float, float]) -> FloatArray:
    """Order four centres: superior right, superior left, inferior left, inferior right (the patient's sides).

    Seen from above a supine patient's right is on the camera's left when the head is at the top of the picture.
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
    """Return the largest relative change of the six distances between markers against a reference layout."""
    pairs = np.array(list(itertools.combinations(range(4), 2)))
    now, then = (
        np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1) for points in (centers_px, reference_px)
    )
    return float(np.abs(now / then - 1.0).max())


def _candidate_centers(gray: GrayImage, search: MarkerSearch) -> list[FloatArray]:
    size = int(np.ceil(search.diameter_px * search.diameter_tolerance)) | 1
    smooth = cv2.GaussianBlur(gray, (3, 3), 0)
    opened = cv2.morphologyEx(smooth, cv2.MORPH_OPEN, np.ones((size, size), np.uint8))
    hat = cv2.subtract(smooth, opened)
    strong = hat[hat > search.min_contrast / 2]
    if strong.size == 0:
        return []
    threshold, _ = cv2.threshold(
        np.ascontiguousarray(strong).reshape(1, -1), 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU
    )
    # Light is uneven: Otsu's level is right for the brightest sticker, so half of it still finds the darkest.
    level = max(search.min_contrast * 0.6, 0.5 * float(threshold))
    count, _, stats, centroids = cv2.connectedComponentsWithStats((hat > level).astype(np.uint8), connectivity=4)
    sides = stats[1:count, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]
    low, high = search.diameter_px / search.diameter_tolerance, search.diameter_px * search.diameter_tolerance * 1.3
    fits = (sides >= 0.5 * low).all(axis=1) & (sides <= high).all(axis=1)
    return list(centroids[1:count][fits])


def _track_one(color: ColorImage, expected: FloatArray, search: MarkerSearch) -> _Blob | None:
    reach = round(1.6 * search.diameter_px)
    left, top = (int(value) - reach for value in np.round(expected))
    left, top = max(left, 0), max(top, 0)
    window = color[top : top + 2 * reach + 1, left : left + 2 * reach + 1]
    if min(window.shape[:2]) < search.diameter_px:
        return None
    gray = window.min(axis=2)
    blob = _refine(gray, expected - (left, top), search)
    if blob is None:
        return None
    return _Blob(center_px=blob.center_px + np.array([left, top]), score=blob.score, diameter_px=blob.diameter_px)


def _refine(gray: GrayImage, start: FloatArray, search: MarkerSearch) -> _Blob | None:
    """Settle on the centre of the sticker near ``start`` and check that it is one."""
    center = np.asarray(start, dtype=np.float64)
    disc: tuple[FloatArray, FloatArray, FloatArray] | None = None
    for _ in range(4):
        disc = _disc_weights(gray, center, search)
        if disc is None:
            return None
        weights, x, y = disc
        total = float(weights.sum())
        if total <= 0.0:
            return None
        moved = np.array([(weights * x).sum() / total, (weights * y).sum() / total])
        step = float(np.hypot(*(moved - center)))
        center = moved
        if step < 0.02:
            break
    if disc is None:
        return None
    return _judge(disc, center, search)


def _disc_weights(
    gray: GrayImage, center: FloatArray, search: MarkerSearch
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Share of each pixel near ``center`` that belongs to the sticker, by brightness between ring and disc."""
    radius = 0.5 * search.diameter_px
    outer = 2.1 * radius
    left, top = int(np.floor(center[0] - outer)), int(np.floor(center[1] - outer))
    right, bottom = int(np.ceil(center[0] + outer)) + 1, int(np.ceil(center[1] + outer)) + 1
    if left < 0 or top < 0 or right > gray.shape[1] or bottom > gray.shape[0]:
        return None
    patch = gray[top:bottom, left:right].astype(np.float64)
    x, y = np.arange(left, right, dtype=np.float64)[None, :], np.arange(top, bottom, dtype=np.float64)[:, None]
    distance = np.hypot(x - center[0], y - center[1])
    ring = patch[(distance > 1.55 * radius) & (distance <= outer)]
    disc = patch[distance <= 0.5 * radius]
    if ring.size < 8 or disc.size < 4:
        return None
    background, foreground = _middle(ring), _middle(disc)
    # The ring must be darker all around: a bright bed or skin beside a spot is no sticker on a shirt.
    if foreground - background < search.min_contrast or background > search.max_background_share * foreground:
        return None
    if np.mean(ring > 0.5 * (background + foreground)) > 0.12:
        return None
    share = (patch - background) / (foreground - background)
    weights = np.clip((share - 0.25) / 0.5, 0.0, 1.0)
    weights[distance > outer] = 0.0
    return weights, x, y


def _middle(values: FloatArray) -> float:
    """Return the upper median; `np.median` spends ten times as long on a hundred values."""
    half = values.size // 2
    return float(np.partition(values, half)[half])


def _judge(disc: tuple[FloatArray, FloatArray, FloatArray], center: FloatArray, search: MarkerSearch) -> _Blob | None:
    """Measure size and roundness by second moments; a uniform disc of diameter D has variance D squared / 16."""
    weights, x, y = disc
    dx, dy = x - center[0], y - center[1]
    total = weights.sum()
    moments = (
        np.array([[(weights * dx * dx).sum(), (weights * dx * dy).sum()], [0.0, (weights * dy * dy).sum()]]) / total
    )
    moments[1, 0] = moments[0, 1]
    minor, major = (4.0 * np.sqrt(np.maximum(np.linalg.eigvalsh(moments), 1e-9))).tolist()
    # A sticker on a slope is foreshortened across it and keeps its diameter along it.
    ratio = major / search.diameter_px
    fill = float(total) / (0.25 * np.pi * minor * major)  # 1 for a filled ellipse, less for a ring or a ragged patch
    if not 1.0 / search.diameter_tolerance <= ratio <= search.diameter_tolerance:
        return None
    if minor / major < MIN_ASPECT or not 0.85 <= fill <= 1.15:
        return None
    return _Blob(center_px=center, score=1.0 - abs(float(np.log(ratio))), diameter_px=major)


def _distinct(blobs: list[_Blob]) -> list[_Blob]:
    kept: list[_Blob] = []
    for blob in blobs:
        if all(np.hypot(*(blob.center_px - other.center_px)) > 0.5 * blob.diameter_px for other in kept):
            kept.append(blob)
    return kept


def _best_quadrilateral(blobs: list[_Blob], search: MarkerSearch) -> FloatArray | None:
    """Choose the four that bound most of the torso: convex, longer than wide, sides alike, large."""
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
