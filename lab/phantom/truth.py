"""Ground truth of a recording: the file ``truth.npz``, and its computation.

Keys (n depth frames, m colour frames; mm and litres; ``motion = reference depth - depth``):

==================== ============ =============================================================================
``timestamp_us``     (n)          time of each depth frame, as in the recording; the scene's time is the same, in us
``color_timestamp_us`` (m)        likewise for colour
``cell_depth_mm``    (n, 35, 20)  mean depth of each cell of 10 x 10 points of the ROI grid
``whole_depth_mm``   (n)          mean over the whole grid
``thorax_depth_mm``  (n)          mean over rows 0 to 174
``abdomen_depth_mm`` (n)          mean over rows 175 to 349
``point_rc``         (5, 2)       five grid points (row, column)
``point_depth_mm``   (n, 5)       depth there
``full_index``       (f)          the depth frames whose whole grid is stored
``full_depth_mm``    (f, 350, 200) depth of the whole grid in those frames
``volume_l``         (n)          volume the skin swept since frame 0, under the quadrilateral of the stickers
``markers_px``       (m, 4, 2)    sticker centres (x, y) in each colour frame: superior right, superior left, inferior
                                  left, inferior right
``depth_markers_px`` (n, 4, 2)    the same at the depth frames' times: the quadrilateral of the ROI
``trace_s``, ``trace_mm`` (k), (k, 2) the signals, abdomen and thorax, that drove the skin
``labels``           json         events: name, start_us, end_us, detail; and scenario, volunteer, seed
                                  (with two more stickers also ``split_rows``: their line at column 0 and 199)
``spirometer_lag_s`` ()           an event t seconds after the first depth frame is at t + lag in ``flow.csv``
``laser_column_px``  (c)          only with a laser: columns of the colour picture
``laser_row_px``     (m, c)       row at which the laser's line crosses each of them in each colour frame
``laser_depth_mm``   (m, c)       depth there: z in the depth camera's frame
==================== ============ =============================================================================

The ROI grid: 350 rows from superior, 200 columns from the patient's right; grid point (row, column) lies where the
projective map of the corners (0, 0), (0, 199), (349, 199), (349, 0) to the four sticker centres takes it in the
*colour* picture (distorted pixels). Its depth is z, in the depth camera's frame, of the skin its colour ray meets: the
body without occluders. A cell's mean is taken over its 10 x 10 points by a rule of 3 x 3 nodes that is exact
for polynomials up to degree five in each direction (within 0.002 mm here); the halves and the whole are means of cells.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates, spline_filter

from engine.core.errors import RecordingError
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, FloatArray
from lab.phantom.anatomy import MODES, Anatomy
from lab.phantom.falsifications import Blind
from lab.phantom.rig import Rig
from lab.phantom.scenarios import Pose
from lab.phantom.view import Frustum, Rays

Grid = npt.NDArray[np.float64]
CELL_PX = 10
OPTIONAL = ("spirometer_lag_s", "laser_column_px", "laser_row_px", "laser_depth_mm")
"""Keys that older files, and files without a laser, lack."""
POINTS_RC = np.array([(70, 60), (70, 140), (175, 100), (280, 60), (280, 140)])
_SPLINE_STEP_MM = 2.0
_SPLINE_HALF_MM = (210.0, 270.0)
_REST_STEPS = 12
_FRAME_STEPS = 3
_HALVES = (slice(0, 18), slice(18, 36))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """Content of ``truth.npz``: the arrays of the table above, n depth frames and m colour frames."""

    timestamp_us: npt.NDArray[np.int64]
    color_timestamp_us: npt.NDArray[np.int64]
    cell_depth_mm: FloatArray
    whole_depth_mm: FloatArray
    thorax_depth_mm: FloatArray
    abdomen_depth_mm: FloatArray
    point_rc: npt.NDArray[np.int64]
    point_depth_mm: FloatArray
    full_index: npt.NDArray[np.int64]
    full_depth_mm: FloatArray
    volume_l: FloatArray
    markers_px: FloatArray
    depth_markers_px: FloatArray
    trace_s: FloatArray
    trace_mm: FloatArray
    labels: str
    spirometer_lag_s: FloatArray | None = None
    laser_column_px: FloatArray | None = None
    laser_row_px: FloatArray | None = None
    laser_depth_mm: FloatArray | None = None

    @property
    def events(self) -> list[dict[str, object]]:
        """The labelled events: ``name``, ``start_us``, ``end_us``, ``detail``."""
        events: list[dict[str, object]] = json.loads(self.labels)["events"]
        return events

    def save(self, path: Path) -> None:
        """Write ``truth.npz``; the same values give the same bytes."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        arrays = {name: np.asarray(value) for name, value in values.items() if value is not None}
        arrays["cell_depth_mm"] = arrays["cell_depth_mm"].astype(np.float32)
        with path.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)


def load_truth(path: Path) -> Truth:
    """Read ``truth.npz``; raise RecordingError if the file is invalid."""
    try:
        with path.open("rb") as source, np.load(source, allow_pickle=False) as file:
            wanted = [name for name in Truth.__dataclass_fields__ if name in file or name not in OPTIONAL]
            arrays = {name: file[name] for name in wanted if name != "labels"}
            return Truth(labels=str(file["labels"]), **arrays)
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise RecordingError(f"{path.name}: is no truth of a virtual volunteer ({error})") from error


class Skin:
    """The body's surface as cubic splines, and the stickers on it; the truth is computed from these."""

    def __init__(self, anatomy: Anatomy, blind: Blind | None = None) -> None:
        self.anatomy = anatomy
        half_x, half_y = _SPLINE_HALF_MM
        x_mm, y_mm = np.meshgrid(
            np.arange(-half_x, half_x + 0.1, _SPLINE_STEP_MM), np.arange(-half_y, half_y + 0.1, _SPLINE_STEP_MM)
        )
        self._rest = spline_filter(anatomy.trunk_height(x_mm, y_mm))
        self._modes = np.stack([spline_filter(mode) for mode in anatomy.modes(x_mm, y_mm)])
        self.rise: Grid = np.zeros_like(self._rest)
        """Coefficients of the whole rise below a blind area, to be added to those of the surface."""
        if blind is not None:
            self.rise += blind.raised_mm * spline_filter(blind.inside(anatomy, y_mm))
        anchors = anatomy.anchors_mm
        self._anchor_rest = anatomy.trunk_height(anchors[:, 0], anchors[:, 1])
        self._anchor_modes = anatomy.modes(anchors[:, 0], anchors[:, 1])
        self._volume = _mode_volumes_l(anatomy)

    def spline(self, weights_mm: FloatArray) -> Grid:
        """Coefficients of the surface for one set of mode weights."""
        spline = self._rest.copy()
        for weight, mode in zip(weights_mm, self._modes, strict=True):
            spline += weight * mode
        return spline

    def height(self, spline: Grid, x_mm: FloatArray, y_mm: FloatArray) -> Grid:
        """Height of the surface [mm]."""
        at = np.stack([(y_mm + _SPLINE_HALF_MM[1]) / _SPLINE_STEP_MM, (x_mm + _SPLINE_HALF_MM[0]) / _SPLINE_STEP_MM])
        return np.asarray(map_coordinates(spline, at, order=3, prefilter=False, mode="nearest"))

    def anchors(self, weights_mm: FloatArray) -> Grid:
        """Sticker centres (x, y, z down) in the body frame [mm], shape (4, 3)."""
        height = self._anchor_rest + (self._anchor_modes * np.asarray(weights_mm)[:, None]).sum(axis=0)
        return np.column_stack([self.anatomy.anchors_mm, -height])

    def volume_l(self, weights_mm: FloatArray) -> Grid:
        """Volume over rest under the quadrilateral [l]; ``weights_mm`` of shape (..., 8)."""
        return np.asarray((np.asarray(weights_mm) * self._volume).sum(axis=-1))


def _mode_volumes_l(anatomy: Anatomy) -> Grid:
    """Integral of each field over the quadrilateral of the stickers [l/mm]."""
    nodes, weights = np.polynomial.legendre.leggauss(48)
    s, t = np.meshgrid(0.5 + 0.5 * nodes, 0.5 + 0.5 * nodes)
    area = 0.25 * weights[:, None] * weights[None, :]
    first, second, third, fourth = anatomy.anchors_mm  # around: 00, 10, 11, 01 in (s, t)
    point = [
        (1 - s) * (1 - t) * first[i] + s * (1 - t) * second[i] + s * t * third[i] + (1 - s) * t * fourth[i]
        for i in (0, 1)
    ]
    ds = [(1 - t) * (second[i] - first[i]) + t * (third[i] - fourth[i]) for i in (0, 1)]
    dt = [(1 - s) * (fourth[i] - first[i]) + s * (third[i] - second[i]) for i in (0, 1)]
    area = area * np.abs(ds[0] * dt[1] - ds[1] * dt[0])
    return np.asarray((anatomy.modes(point[0], point[1]) * area).sum(axis=(1, 2)) * 1e-6)


def volume_ratio(anatomy: Anatomy) -> float:
    """Volume change per mm of the abdomen's signal over the volume change per mm of the thorax's."""
    volumes = _mode_volumes_l(anatomy)
    return float(volumes[:3].sum() / volumes[3:6].sum())


def sticker_px(rig: Rig, skin: Skin, weights_mm: FloatArray, pose: Pose) -> Grid:
    """Sticker centres in the colour picture [px], shape (4, 2)."""
    camera_from_body = Frustum(rig.color_from_couch, pose).camera_from_body
    return np.asarray(rig.color.project(camera_from_body.apply(skin.anchors(weights_mm))))


class RoiTruth:
    """Solver for the depth of ROI grid points in one pose of the body."""

    def __init__(self, rig: Rig, rays: Rays, skin: Skin, pose: Pose) -> None:
        self._rig, self._rays, self._skin = rig, rays, skin
        self._pose = pose
        self._frustum = Frustum(rig.color_from_couch, pose)
        depth = Frustum(rig.depth_from_couch, pose).camera_from_body
        self._z_row, self._z_offset = depth.rotation[2], float(depth.translation_mm[2])
        self._nodes_rc, self._row_shares, self._band_shares = _node_layout()
        self._start = self._start_from_rest(self._nodes_rc)

    def cells(self, weights_mm: FloatArray, raised_share: float = 0.0) -> tuple[Grid, Grid, Grid]:
        """Return cell means (35, 20), the means of the superior and the inferior half (2), the five points (5) [mm].

        ``raised_share`` is how much of the rise below a blind area has come.
        """
        depth = self._solve(self._nodes_rc, weights_mm, self._start, raised_share)
        points = depth[-len(POINTS_RC) :]
        nodes = depth[: -len(POINTS_RC)].reshape(len(self._band_shares), 3, ROI_COLUMNS // CELL_PX, 3)
        bands = (nodes * self._row_shares[:, :, None, None] * _RULE_SHARES).sum(axis=(1, 3))
        # Bands 17 and 18 are the two halves of the cell row that the thorax and the abdomen share.
        cells = np.concatenate([bands[:17], bands[17:19].mean(axis=0)[None], bands[19:]])
        halves = np.array([(bands[part].mean(axis=1) * self._band_shares[part]).sum() for part in _HALVES])
        return cells, halves, points

    def depth(self, grid_rc: FloatArray, weights_mm: FloatArray) -> Grid:
        """Depth z in the depth camera's frame [mm] at grid points (row, column), shape (N, 2)."""
        return self._solve(grid_rc, weights_mm, self._start_from_rest(grid_rc))

    def _solve(
        self, grid_rc: FloatArray, weights_mm: FloatArray, start: tuple[Grid, Grid], raised_share: float = 0.0
    ) -> Grid:
        directions = self._ray_directions(grid_rc, weights_mm)
        color_depth, step = start
        surface = self._skin.spline(weights_mm)
        if raised_share:
            surface += raised_share * self._skin.rise
        color_depth = self._meet(surface, directions, color_depth, step, _FRAME_STEPS)
        x, y, z = (c + color_depth * d for c, d in zip(self._frustum.center, directions, strict=True))
        return np.asarray(self._z_row[0] * x + self._z_row[1] * y + self._z_row[2] * z + self._z_offset)

    def _ray_directions(self, grid_rc: FloatArray, weights_mm: FloatArray) -> tuple[Grid, ...]:
        pixels = _map_grid(grid_rc, sticker_px(self._rig, self._skin, weights_mm, self._pose))
        x, y, z = self._frustum.directions(*self._rays.at(pixels))
        return np.asarray(x), np.asarray(y), np.asarray(z)

    def _start_from_rest(self, grid_rc: FloatArray) -> tuple[Grid, Grid]:
        """Depth at rest and its Newton step, the start for every frame: the grid hardly moves over the skin."""
        at_rest = np.zeros(MODES)
        directions = self._ray_directions(grid_rc, at_rest)
        spline = self._skin.spline(at_rest)
        depth = (self._frustum.height_mm - 200.0) / directions[2]
        depth = self._meet(spline, directions, depth, 1.0 / directions[2], _REST_STEPS)
        x, y = (self._frustum.center[i] + depth * directions[i] for i in (0, 1))
        slope_x = 0.5 * (self._skin.height(spline, x + 1.0, y) - self._skin.height(spline, x - 1.0, y))
        slope_y = 0.5 * (self._skin.height(spline, x, y + 1.0) - self._skin.height(spline, x, y - 1.0))
        return depth, 1.0 / (directions[2] + slope_x * directions[0] + slope_y * directions[1])

    def _meet(self, spline: Grid, directions: tuple[Grid, ...], depth: Grid, step: Grid, steps: int) -> Grid:
        for _ in range(steps):
            x, y = (self._frustum.center[i] + depth * directions[i] for i in (0, 1))
            gap = self._frustum.height_mm - depth * directions[2] - self._skin.height(spline, x, y)
            depth = depth + gap * step
        return depth


def _rule(points: int) -> tuple[Grid, Grid]:
    """Three nodes and weights that average ``points`` whole numbers from 0 exactly up to degree five."""
    centered = np.arange(points) - 0.5 * (points - 1)
    second, fourth = float((centered**2).mean()), float((centered**4).mean())
    reach = np.sqrt(fourth / second)
    share = second / (2.0 * reach**2)
    return 0.5 * (points - 1) + np.array([-reach, 0.0, reach]), np.array([share, 1.0 - 2.0 * share, share])


_RULE_NODES, _RULE_SHARES = _rule(CELL_PX)


def _node_layout() -> tuple[Grid, Grid, Grid]:
    """Lay out the nodes of 36 bands of rows (the cell rows, the middle one cut into its halves).

    Returns the grid points (row, column) of all nodes band by band, then of the five points; each band's row weights,
    shape (36, 3); and each band's share of its half of the grid.
    """
    bands = [(row, CELL_PX) for row in range(0, ROI_ROWS, CELL_PX) if row != 170]
    bands = sorted([*bands, (170, CELL_PX // 2), (175, CELL_PX // 2)])
    rules = [_rule(size) for _, size in bands]
    rows = np.concatenate([start + nodes for (start, _), (nodes, _) in zip(bands, rules, strict=True)])
    columns = (np.arange(0, ROI_COLUMNS, CELL_PX)[:, None] + _RULE_NODES).ravel()
    grid = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
    band_shares = np.array([size / (ROI_ROWS / 2) for _, size in bands])
    return np.concatenate([grid, POINTS_RC]), np.stack([shares for _, shares in rules]), band_shares


def _map_grid(grid_rc: FloatArray, corners_px: FloatArray) -> Grid:
    """Map grid points (row, column) to colour pixels (x, y) by the projective map of the corners."""
    right, bottom = ROI_COLUMNS - 1.0, ROI_ROWS - 1.0
    columns, rows = np.array([0.0, right, right, 0.0]), np.array([0.0, 0.0, bottom, bottom])
    u, v = corners_px[:, 0], corners_px[:, 1]
    zero, one = np.zeros(4), np.ones(4)
    system = np.concatenate(
        [
            np.column_stack([columns, rows, one, zero, zero, zero, -columns * u, -rows * u]),
            np.column_stack([zero, zero, zero, columns, rows, one, -columns * v, -rows * v]),
        ]
    )
    a, b, c, d, e, f, g, h = np.linalg.solve(system, np.concatenate([u, v]))
    row, column = grid_rc[:, 0], grid_rc[:, 1]
    scale = g * column + h * row + 1.0
    return np.column_stack([(a * column + b * row + c) / scale, (d * column + e * row + f) / scale])


def roi_nodes() -> Grid:
    """All 70,000 grid points (row, column), row by row."""
    rows, columns = np.meshgrid(np.arange(float(ROI_ROWS)), np.arange(float(ROI_COLUMNS)), indexing="ij")
    return np.column_stack([rows.ravel(), columns.ravel()])
