"""Rigid motion between the patient's surfaces of two fractions, without trusting that the markers are where they were.

Markers are attached again in every fraction, and the grid's nodes move with them. So nodes are not compared by their
number: each node of the first surface is to lie anywhere *on* the second one (point-to-plane registration; Chen and
Medioni, Image and Vision Computing 10, 1992, doi:10.1016/0262-8856(92)90066-C). How well that determines each degree of
freedom follows from the shape itself: a slide along a smooth surface changes nothing. The markers add what their
placement is worth.

Rigid motion between two sets of corresponding points (Kabsch algorithm).
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

from engine.core.frames import NODE_COLUMNS, NODE_ROWS, BoolArray, FloatArray

MIN_POINTS = 12
ROWS, COLUMNS = NODE_ROWS - 1, NODE_COLUMNS - 1
"""The last row and column of nodes repeat the depth of the last pixels; they are left out."""
MARKER_PLACEMENT_MM = 5.0
"""How exactly markers are put back on bare skin; on tattoos it is 1 to 2 mm."""
SURFACE_MM = 0.4
"""Least standard deviation of the distance between two surfaces of one body [mm]: sensor, model and end of exhale."""
PATCH_MM = 50.0
"""Errors of the surface within this distance are alike: so many nodes count as one."""
LEAST_SHARE = 0.6
"""Least share of the nodes that must lie over the second surface."""
FOOT_STEPS = 2
ROUNDS = 15
CHOOSING_ROUNDS = 4
"""Rounds in which the nodes over the other surface are chosen; then they stay, so that the solution settles."""
RIM = 0.1
"""How far nodes may lie over the second surface's rim [nodes]: there the distance along its normal is still known."""
CONVERGED = 1e-2
"""Largest step [mm, and mm at 100 mm from the middle] of a solution."""
LEVER_MM = 100.0
_CORNERS = (0, COLUMNS - 1, (ROWS - 1) * COLUMNS, ROWS * COLUMNS - 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidFit:
    """A rigid motion between two sets of points, and the remaining difference.

    Attributes
    ----------
    shift_mm
        From the centre of the first to the centre of the second (x, y, z) [mm].
    tilt_deg
        Angle of the rotation about that centre [deg].
    shape_mm
        Root mean square distance of the points after the rigid motion [mm].
    rotation
        About that centre, shape (3, 3).
    share
        Share of the pairs that was used, 0 to 1.
    """

    shift_mm: tuple[float, float, float]
    tilt_deg: float
    shape_mm: float
    rotation: FloatArray = field(compare=False, repr=False)
    share: float

    @property
    def distance_mm(self) -> float:
        """Length of the shift [mm]."""
        return float(np.linalg.norm(self.shift_mm))


def rigid_between(first: FloatArray, second: FloatArray) -> RigidFit | None:
    """Fit the rigid motion from ``first`` to ``second``.

    Parameters
    ----------
    first, second
        Points [mm], shape (N, 3); pairs with a NaN are left out.

    Returns
    -------
    RigidFit | None
        None for fewer than 12 pairs.
    """
    both = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    if int(both.sum()) < MIN_POINTS:
        return None
    a, b = first[both], second[both]
    center_a, center_b = a.mean(axis=0), b.mean(axis=0)
    u, _, v = np.linalg.svd((a - center_a).T @ (b - center_b))
    handedness = np.sign(np.linalg.det(u @ v))  # a mirror image is no rotation
    rotation = v.T @ np.diag([1.0, 1.0, handedness]) @ u.T
    left = (b - center_b) - (a - center_a) @ rotation.T
    cosine = np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0)
    x, y, z = (center_b - center_a).tolist()
    return RigidFit(
        shift_mm=(x, y, z),
        tilt_deg=float(np.rad2deg(np.arccos(cosine))),
        shape_mm=float(np.sqrt((left**2).sum(axis=1).mean())),
        rotation=rotation,
        share=float(both.mean()),
    )


class PositionFit(NamedTuple):
    """Shift of the middle along the axes and turn about them, with standard uncertainties.

    ``shift_mm`` and ``shift_uncertainty_mm`` have shape (3,), ``turn_deg`` and ``turn_uncertainty_deg`` too;
    ``shape_mm`` is the root mean square distance that remains.
    """

    shift_mm: FloatArray
    turn_deg: FloatArray
    shift_uncertainty_mm: FloatArray
    turn_uncertainty_deg: FloatArray
    shape_mm: float


class _Pose(NamedTuple):
    """Rotation about the middle, shape (3, 3), and translation [mm], shape (3,)."""

    rotation: FloatArray
    shift_mm: FloatArray


class _Solution(NamedTuple):
    """A step towards the solution, shape (6,), the covariance there, shape (6, 6), and what remains [mm]."""

    step: FloatArray
    covariance: FloatArray
    shape_mm: float


class _Equations(NamedTuple):
    """Rows of the linear system, shape (n, 6), their distances [mm], shape (n,), and their standard deviation [mm]."""

    rows: FloatArray
    distance_mm: FloatArray
    deviation_mm: float

    @property
    def normal(self) -> FloatArray:
        """Information about the six degrees of freedom, shape (6, 6)."""
        return np.asarray(self.rows.T @ self.rows / self.deviation_mm**2)

    @property
    def right_side(self) -> FloatArray:
        """Right side of the normal equations, shape (6,)."""
        return np.asarray(self.rows.T @ self.distance_mm / self.deviation_mm**2)


def position_between(first: FloatArray, second: FloatArray, *, marker_placement_mm: float) -> PositionFit | None:
    """Fit the rigid motion from the surface ``first`` to ``second``.

    Parameters
    ----------
    first, second
        Surfaces at the region's nodes in the depth camera's frame [mm], shape (nodes, 3).
    marker_placement_mm
        Standard deviation of a common shift of all markers on the skin between the two [mm].

    Returns
    -------
    PositionFit | None
        None where too little of both surfaces is known, or they do not overlap.
    """
    start = rigid_between(first, second)
    grids = [one.reshape(NODE_ROWS, NODE_COLUMNS, 3)[:ROWS, :COLUMNS] for one in (first, second)]
    if start is None or not all(np.isfinite(one).all() for one in grids):
        return None
    registration = _Registration(grids[0], _Surface(grids[1]), marker_placement_mm)
    pose = registration.start(start.rotation)
    for _ in range(ROUNDS):
        solution = registration.solve(pose)
        if solution is None:
            return None
        pose = registration.stepped(pose, solution.step)
        if np.abs(solution.step * [1.0, 1.0, 1.0, LEVER_MM, LEVER_MM, LEVER_MM]).max() < CONVERGED:
            return registration.fit(pose, solution)
    return None  # it does not settle: the surfaces are not alike


def body_axes(grid_mm: FloatArray) -> FloatArray:
    """Return unit vectors to the patient's left, to the head, and towards the camera, as rows, shape (3, 3).

    Parameters
    ----------
    grid_mm
        Nodes from superior and the patient's right [mm], shape (rows, columns, 3).
    """
    points = grid_mm.reshape(-1, 3)
    out: FloatArray = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    out = -out if out[2] > 0.0 else out
    up = (grid_mm[0] - grid_mm[-1]).mean(axis=0)
    up = up - (up @ out) * out
    up = up / np.linalg.norm(up)
    return np.stack([np.cross(up, out), up, out])


class _Surface:
    """A surface between its nodes: bicubic, with tangents and normals."""

    def __init__(self, grid_mm: FloatArray) -> None:
        self._middle_mm = grid_mm.reshape(-1, 3).mean(axis=0)
        along, across = np.gradient(grid_mm, axis=0), np.gradient(grid_mm, axis=1)
        normals = np.cross(along, across)
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
        self.normals = normals.reshape(-1, 3)
        self.nodes_mm = grid_mm.reshape(-1, 3)
        self._grid, self._along, self._across, self._normals = (
            np.ascontiguousarray(one, dtype=np.float32) for one in (grid_mm - self._middle_mm, along, across, normals)
        )

    def at(self, places: FloatArray) -> FloatArray:
        """Return the surface at places (row, column), shape (n, 2) [mm], shape (n, 3)."""
        return np.asarray(_between(self._grid, places) + self._middle_mm)

    def normals_at(self, places: FloatArray) -> FloatArray:
        """Return unit normals at places, shape (n, 3)."""
        normals = _between(self._normals, places)
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))

    def feet(self, points_mm: FloatArray, places: FloatArray) -> FloatArray:
        """Return the places on the surface below points [mm], shape (n, 3), beginning with ``places``."""
        for _ in range(FOOT_STEPS):
            gap = points_mm - self.at(places)
            along, across = _between(self._along, places), _between(self._across, places)
            aa, ab, bb = (along**2).sum(axis=1), (along * across).sum(axis=1), (across**2).sum(axis=1)
            a, b = (along * gap).sum(axis=1), (across * gap).sum(axis=1)
            step = np.stack([bb * a - ab * b, aa * b - ab * a], axis=1) / (aa * bb - ab**2)[:, None]
            places = np.asarray(places + np.clip(step, -1.0, 1.0))
        return places


def _between(grid: FloatArray, places: FloatArray) -> FloatArray:
    rows, columns = places.T.astype(np.float32)
    found = cv2.remap(grid, columns[None], rows[None], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found[0], dtype=np.float64)


def _is_over(places: FloatArray) -> BoolArray:
    last = np.array([ROWS - 1.0, COLUMNS - 1.0])
    return np.asarray(((places >= -RIM) & (places <= last + RIM)).all(axis=1))


def _node_mm2(surface: _Surface) -> float:
    """Return the area that one node stands for [mm2]."""
    grid = surface.nodes_mm.reshape(ROWS, COLUMNS, 3)
    along = np.linalg.norm(np.diff(grid, axis=0), axis=2).mean()
    across = np.linalg.norm(np.diff(grid, axis=1), axis=2).mean()
    return float(along * across)


class _Registration:
    """The first surface's nodes, to be laid on the second surface."""

    def __init__(self, grid_mm: FloatArray, other: _Surface, marker_placement_mm: float) -> None:
        self._other, self._placement_mm = other, marker_placement_mm
        points_mm = grid_mm.reshape(-1, 3)
        self._middle_mm, self._axes = points_mm.mean(axis=0), body_axes(grid_mm)
        self._arms_mm = points_mm - self._middle_mm
        self._places: FloatArray = np.mgrid[0:ROWS, 0:COLUMNS].reshape(2, -1).T.astype(np.float64)
        self._is_over: BoolArray = np.ones(len(points_mm), dtype=np.bool_)
        self._rounds = 0
        self._alike = max(1.0, PATCH_MM**2 / _node_mm2(other))

    def start(self, rotation: FloatArray) -> _Pose:
        """Return the pose by which, node by node, the surfaces lie on each other on average."""
        gap_mm = self._other.nodes_mm - self._arms_mm @ rotation.T - self._middle_mm
        return _Pose(rotation, gap_mm.mean(axis=0))

    def solve(self, pose: _Pose) -> _Solution | None:
        """Return the next step; None where too few nodes lie over the other surface."""
        arms_mm = self._arms_mm @ pose.rotation.T
        moved_mm = arms_mm + self._middle_mm + pose.shift_mm
        self._places = self._other.feet(moved_mm, self._places)
        self._rounds += 1
        if self._rounds <= CHOOSING_ROUNDS:
            self._is_over = _is_over(self._places)
        if self._is_over.mean() < LEAST_SHARE:
            return None
        surface, markers = self._on_surface(moved_mm, arms_mm), self._at_markers(moved_mm, arms_mm)
        covariance = np.asarray(np.linalg.inv(surface.normal + markers.normal))
        return _Solution(
            step=-covariance @ (surface.right_side + markers.right_side),
            covariance=covariance,
            shape_mm=float(np.sqrt((surface.distance_mm**2).mean())),
        )

    def stepped(self, pose: _Pose, step: FloatArray) -> _Pose:
        """Return the pose after a step along the axes and about them."""
        turned = np.asarray(cv2.Rodrigues(self._axes.T @ step[3:])[0], dtype=np.float64)
        return _Pose(turned @ pose.rotation, pose.shift_mm + self._axes.T @ step[:3])

    def fit(self, pose: _Pose, solution: _Solution) -> PositionFit:
        """Return the result along the axes."""
        deviation = np.sqrt(np.diag(solution.covariance))
        turn = np.asarray(cv2.Rodrigues(pose.rotation)[0], dtype=np.float64).ravel()
        return PositionFit(
            shift_mm=self._axes @ pose.shift_mm,
            turn_deg=np.rad2deg(self._axes @ turn),
            shift_uncertainty_mm=deviation[:3],
            turn_uncertainty_deg=np.rad2deg(deviation[3:]),
            shape_mm=solution.shape_mm,
        )

    def _on_surface(self, moved_mm: FloatArray, arms_mm: FloatArray) -> _Equations:
        """Ask that each node lies on the other surface."""
        is_over = self._is_over
        places = self._places[is_over]
        normals = self._other.normals_at(places)
        distance_mm = ((moved_mm[is_over] - self._other.at(places)) * normals).sum(axis=1)
        rows = np.hstack([normals @ self._axes.T, np.cross(arms_mm[is_over], normals) @ self._axes.T])
        deviation_mm = float(np.sqrt(SURFACE_MM**2 + (distance_mm**2).mean()))
        return _Equations(rows, distance_mm, deviation_mm * self._alike**0.5)

    def _at_markers(self, moved_mm: FloatArray, arms_mm: FloatArray) -> _Equations:
        """Ask that the corners lie where the markers are, along the surface only; all four may be off the same way."""
        rows, distance_mm = [], []
        for corner in _CORNERS:
            normal, arm_mm = self._other.normals[corner], arms_mm[corner]
            along = np.eye(3) - np.outer(normal, normal)
            turns = np.stack([np.cross(axis, arm_mm) for axis in self._axes], axis=1)
            rows.append(along @ np.hstack([self._axes.T, turns]))
            distance_mm.append(along @ (moved_mm[corner] - self._other.nodes_mm[corner]))
        return _Equations(np.vstack(rows), np.concatenate(distance_mm), self._placement_mm * len(_CORNERS) ** 0.5)
