"""The scene beside the patient: couch and floor stand still, so that a change of their depth is the camera's.

The depth picture is read in blocks. Blocks that lie behind the patient's chest, stand still for a second and are flat
are the scene; arms and flanks are round. A small movement of the camera towards it, or a tilt, changes the depth of all
of them like that of a plane. Where the couch and the floor are both seen, they are followed apart too: a couch that
moves over a floor that stays is a few blocks among many.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.compiled import FramePath
from engine.core.frames import THIN_DEPTH_PX, DepthImage, FloatArray
from engine.core.geometry import Intrinsics

BLOCK_PX = 16
SAMPLE_PX = THIN_DEPTH_PX
SAMPLES = BLOCK_PX // SAMPLE_PX
WHOLLY_SEEN = 0.99
"""Share of seen readings above which none of a block's sixteen is missing."""
BEHIND_MM = 60.0
"""Least distance of the scene behind the deepest marker: a couch is farther, most of the patient nearer."""
LEARNING_US = 1_000_000
LEAST_FRAMES = 10
STILL_MM = 5.0
"""Largest standard deviation of a still block at 1 m; with structured light it grows with the square of the depth."""
FLAT_MM = 1.5
"""Largest distance of a flat block at 1 m from the middle of its neighbours; it grows like the noise."""
LEAST_BLOCKS = 40
INLIER_MM = 15.0
"""A block that changed more is covered or uncovered: by a person beside the couch, for example."""
LEAST_INLIERS = 0.5
LAYER_GAP_MM = 200.0
"""Least step of depth between a couch and what lies below it."""
EDGE_MM = 60.0
"""Largest step of depth from a block of one layer to its neighbours."""
LEAST_OF_LAYER = 20
STANDS_SHARE = 0.4
"""A floor that moved by less than this share of the couch's movement stands still."""
ROUNDS = 3
NAMED_MM = 1.0
"""A movement from which it is asked what has moved."""
_INLIERS_MM = np.array([-INLIER_MM, INLIER_MM])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Reference:
    """The picked blocks' numbers and depth [mm], the plane's terms, shape (blocks, 3), and weights."""

    picked: npt.NDArray[np.intp]
    depth_mm: FloatArray
    terms: FloatArray
    weights: FloatArray


class _Layer(NamedTuple):
    """Blocks of the couch, or of what lies below it: numbers, depth at the reference [mm], terms of a plane."""

    places: npt.NDArray[np.intp]
    depth_mm: FloatArray
    terms: FloatArray

    def change_mm(self, blocks_mm: FloatArray) -> float:
        """Return the median change of depth; NaN where half of the blocks are covered or uncovered."""
        change_mm = np.sort(blocks_mm[self.places] - self.depth_mm)  # NaN comes last
        first, last = change_mm.searchsorted(_INLIERS_MM).tolist()
        return float(change_mm[(first + last) // 2]) if last - first >= LEAST_INLIERS * len(change_mm) else math.nan

    def movement_mm(self, blocks_mm: FloatArray) -> float | None:
        """Return the root mean square of a rigid movement: of a tilt, the median change is none."""
        change_mm = blocks_mm[self.places] - self.depth_mm
        is_inlier = np.abs(change_mm) <= INLIER_MM
        if np.count_nonzero(is_inlier) < LEAST_INLIERS * len(change_mm):
            return None
        plane, *_ = np.linalg.lstsq(self.terms[is_inlier], change_mm[is_inlier])
        return float(np.sqrt(np.mean((self.terms @ plane) ** 2)))


_NO_LAYER = _Layer(np.empty(0, dtype=np.intp), np.empty(0), np.empty((0, 3)))


class StaticScene:
    """Learns the scene in the first second that shows enough of it, then measures how it has moved.

    Owned by the pipeline. A restart learns it again.
    """

    def __init__(self, camera: Intrinsics) -> None:
        self._shape = _blocks_in(camera.height), _blocks_in(camera.width)
        self._rays = _block_rays(camera)
        self._seen: list[FloatArray] = []
        self._began_us: int | None = None
        self._reference: _Reference | None = None
        self._layers: tuple[_Layer, _Layer] | None = None
        self.has_floor_moved: bool | None = None

    def restart(self) -> None:
        """Learn the scene again."""
        self._seen, self._began_us, self._reference, self._layers = [], None, None, None
        self.has_floor_moved = None

    def follow(self, thin_mm: DepthImage, points_mm: FloatArray, timestamp_us: int) -> FloatArray | None:
        """Return how the scene's depth has changed at some points [mm], as a rigid movement of the camera changes it.

        Parameters
        ----------
        thin_mm
            Every `SAMPLE_PX`-th row and column of the depth picture.
        points_mm
            The markers in the camera's frame, shape (n, 3). The scene lies behind them.

        Returns
        -------
        FloatArray | None
            Shape (n,); None while the scene is learned, and where too little of it is seen.
        """
        if (thin_mm.shape[0] // SAMPLES, thin_mm.shape[1] // SAMPLES) != self._shape:
            return None
        blocks_mm = _blocks_mm(thin_mm)
        if self._reference is None:
            self._learn(blocks_mm, float(points_mm[:, 2].max()), timestamp_us)
            return None
        couch = None if self._layers is None else self._layers[0]
        moved_mm, couch_mm = _movement(self._reference, couch, blocks_mm, points_mm)
        return moved_mm if self._layers is None else self._with_couch(self._layers[1], moved_mm, couch_mm, blocks_mm)

    def _with_couch(
        self, floor: _Layer, moved_mm: FloatArray | None, couch_mm: float, blocks_mm: FloatArray
    ) -> FloatArray | None:
        """Return the scene's movement, or the couch's where that is larger, and find out whether the floor moved.

        The couch is often seen on one side of the patient only: how far it is raised is measured, and no tilt.
        """
        largest_mm = 0.0 if moved_mm is None else max(map(abs, moved_mm.tolist()))
        if abs(couch_mm) > largest_mm:  # not of NaN
            largest_mm, moved_mm = abs(couch_mm), np.full(4, couch_mm)
        self.has_floor_moved = None
        if largest_mm >= NAMED_MM:
            floor_mm = floor.movement_mm(blocks_mm)
            self.has_floor_moved = None if floor_mm is None else floor_mm > STANDS_SHARE * largest_mm
        return moved_mm

    def _learn(self, blocks_mm: FloatArray, nearest_mm: float, timestamp_us: int) -> None:
        if self._began_us is None or timestamp_us < self._began_us:
            self._began_us, self._seen = timestamp_us, []
        self._seen.append(blocks_mm)
        if timestamp_us - self._began_us < LEARNING_US or len(self._seen) < LEAST_FRAMES:
            return
        seen = np.array(self._seen)
        self._seen, self._began_us = [], None
        is_seen = np.isfinite(seen).all(axis=0)
        seen = np.where(is_seen, seen, 0.0)
        mean_mm, deviation_mm = seen.mean(axis=0), seen.std(axis=0)
        is_behind = mean_mm > nearest_mm + BEHIND_MM
        noise = (mean_mm / 1000.0) ** 2
        is_flat = _bend_mm(mean_mm.reshape(self._shape)).ravel() <= FLAT_MM * noise
        is_picked = is_seen & is_behind & is_flat & (deviation_mm <= STILL_MM * noise)
        if np.count_nonzero(is_picked) < LEAST_BLOCKS:
            return
        depth_mm = mean_mm[is_picked]
        self._reference = _Reference(
            picked=np.flatnonzero(is_picked),
            depth_mm=depth_mm,
            terms=_terms(self._rays[is_picked] * depth_mm[:, None]),
            weights=1.0 / depth_mm**4,
        )
        # A block at an edge holds some of both, in a share that moves with it.
        is_whole = is_picked & (_step_mm(mean_mm.reshape(self._shape)).ravel() <= EDGE_MM)
        below_mm = _lower_end_mm(mean_mm[is_whole])
        if below_mm is not None:
            is_couch = mean_mm <= below_mm
            places = (np.flatnonzero(is_whole & is_couch), np.flatnonzero(is_whole & ~is_couch))
            couch, floor = (
                _Layer(of_layer, mean_mm[of_layer], _terms(self._rays[of_layer] * mean_mm[of_layer, None]))
                for of_layer in places
            )
            self._layers = (couch, floor)


def _lower_end_mm(depth_mm: FloatArray) -> float | None:
    """Return the depth of the deepest block of the couch; None where couch and floor are not both seen."""
    ordered = np.sort(depth_mm)
    steps = np.diff(ordered)[LEAST_OF_LAYER - 1 : len(ordered) - LEAST_OF_LAYER]
    if not len(steps) or steps.max() < LAYER_GAP_MM:
        return None
    return float(ordered[LEAST_OF_LAYER - 1 + int(np.argmax(steps))])


def _movement(
    reference: _Reference, couch: _Layer | None, blocks_mm: FloatArray, points_mm: FloatArray
) -> tuple[FloatArray | None, float]:
    """Fit a plane to the blocks' change robustly; return it at the points, and the couch's median change [mm]."""
    compiled, of_couch = FramePath.kernels, _NO_LAYER if couch is None else couch
    if compiled is not None:
        moved_mm = np.empty(len(points_mm) + 1)  # the couch's is the last
        is_fitted = compiled.scene_movement(
            blocks_mm,
            reference.picked,
            reference.depth_mm,
            reference.terms,
            reference.weights,
            of_couch.places,
            of_couch.depth_mm,
            INLIER_MM,
            LEAST_INLIERS,
            ROUNDS,
            points_mm,
            moved_mm,
        )
        if is_fitted is not None:
            return moved_mm[:-1] if is_fitted else None, moved_mm[-1].item()
    of_couch_mm = math.nan if couch is None else couch.change_mm(blocks_mm)
    plane = _fit_plane(reference, blocks_mm)
    if plane is None:
        return None, of_couch_mm
    middle, across, along = plane.tolist()
    at_points = [middle + across * x / 1000.0 + along * y / 1000.0 for x, y, _ in points_mm.tolist()]
    return np.array(at_points), of_couch_mm


def _fit_plane(reference: _Reference, blocks_mm: FloatArray) -> FloatArray | None:
    """Fit with numpy."""
    change = blocks_mm[reference.picked] - reference.depth_mm
    is_inlier = np.abs(change) <= INLIER_MM  # NaN is none
    plane: FloatArray = np.zeros(3)
    for _ in range(ROUNDS):
        if np.count_nonzero(is_inlier) < LEAST_INLIERS * len(change):
            return None
        weighted = reference.terms[is_inlier] * reference.weights[is_inlier, None]
        plane = np.linalg.solve(weighted.T @ reference.terms[is_inlier], weighted.T @ change[is_inlier])
        misfit = np.abs(change - reference.terms @ plane)
        limit = 3.0 * 1.5 * np.median(misfit[is_inlier]) + 0.5
        is_inlier = misfit <= min(limit, INLIER_MM)
    return plane


def _bend_mm(depth_mm: FloatArray) -> FloatArray:
    """Return how far each block is from the middle of its neighbours, the larger of both directions; inf at the rim."""
    bend_mm = np.full(depth_mm.shape, np.inf)
    inner = depth_mm[1:-1, 1:-1]
    along, across = depth_mm[:-2, 1:-1] + depth_mm[2:, 1:-1], depth_mm[1:-1, :-2] + depth_mm[1:-1, 2:]
    bend_mm[1:-1, 1:-1] = np.maximum(np.abs(inner - 0.5 * along), np.abs(inner - 0.5 * across))
    return bend_mm


def _step_mm(depth_mm: FloatArray) -> FloatArray:
    """Return the largest step of depth from each block to its four neighbours; inf at the rim."""
    step_mm = np.full(depth_mm.shape, np.inf)
    inner = depth_mm[1:-1, 1:-1]
    neighbours = (depth_mm[:-2, 1:-1], depth_mm[2:, 1:-1], depth_mm[1:-1, :-2], depth_mm[1:-1, 2:])
    step_mm[1:-1, 1:-1] = np.max([np.abs(inner - one) for one in neighbours], axis=0)
    return step_mm


def _terms(points_mm: FloatArray) -> FloatArray:
    """Return 1 and the places across and along the picture [m], shape (n, 3)."""
    return np.stack([np.ones(len(points_mm)), points_mm[:, 0] / 1000.0, points_mm[:, 1] / 1000.0], axis=1)


def _blocks_mm(thin_mm: DepthImage) -> FloatArray:
    """Return the mean depth of each block [mm], row by row; NaN where a reading is missing."""
    compiled = FramePath.kernels
    if compiled is None:
        return _mean_blocks_mm(thin_mm)
    blocks_mm = np.empty((thin_mm.shape[0] // SAMPLES, thin_mm.shape[1] // SAMPLES))
    compiled.scene_blocks(np.ascontiguousarray(thin_mm), SAMPLES, blocks_mm)
    return blocks_mm.ravel()


def _mean_blocks_mm(thin_mm: DepthImage) -> FloatArray:
    """Return the same with OpenCV."""
    rows, columns = thin_mm.shape[0] // SAMPLES, thin_mm.shape[1] // SAMPLES
    whole_mm = thin_mm[: rows * SAMPLES, : columns * SAMPLES].astype(np.float32)
    if 0 in {rows, columns}:
        return np.empty(0)
    mean_mm = cv2.resize(whole_mm, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float64)
    seen = cv2.resize((whole_mm > 0.0).astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
    return np.where(seen > WHOLLY_SEEN, mean_mm, np.nan).ravel()


def _blocks_in(pixels: int) -> int:
    """Return how many whole blocks of samples there are along a side of the picture."""
    return -(-pixels // SAMPLE_PX) // SAMPLES


def _block_rays(camera: Intrinsics) -> FloatArray:
    """Return the rays of unit depth of the middles of the blocks' samples, shape (blocks, 3)."""
    rows, columns = (
        np.arange(_blocks_in(size)) * BLOCK_PX + 0.5 * (BLOCK_PX - SAMPLE_PX) for size in (camera.height, camera.width)
    )
    x, y = np.meshgrid(columns, rows)
    return camera.rays(np.stack([x.ravel(), y.ravel()], axis=1))
