"""A motion model prepared for measuring: all quantities that are linear in the coefficients, precomputed.

Preparation runs in the trainer's thread, so the switch between two frames costs the engine thread no time.

The share of each region that was seen in a frame counts sampled points with a reading that the model explains, by
area: the model extrapolates into what the camera does not see, so a region's motion alone does not show whether it was
measured. A sampled point stands for the pixels of the grid that are nearest to it; a point that the model does not
know counts as unseen. The weights of the cells are separable, so all shares take a few matrix products per frame.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from engine.core.compiled import FramePath
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, ROI_COLUMNS, ROI_ROWS, BoolArray, FloatArray, SeenShares, frozen
from engine.core.motion_model import MotionModel
from engine.motion.named_regions import coverage
from engine.motion.stages.projection import SAMPLED_SHAPE, STRIDE_PX, Basis, modes_of, prepare_basis
from engine.motion.stages.regions import (
    POINT_SURROUNDINGS_PX,
    WIDE,
    RegionLayout,
    RegionMeans,
    grid_shape,
    prepare_regions,
    thorax_coverage,
)
from engine.motion.stages.roi import at_nodes
from engine.motion.stages.surface import grid_triangles, volume_l

DIGITS = 4

_TRIANGLES = grid_triangles(NODE_ROWS, NODE_COLUMNS)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenWeights:
    """Weight of each sampled point in each region of a layout; the weights of a region sum to 1.

    Attributes
    ----------
    rows, columns
        Of the cells, shapes (rows, 88) and (50, columns).
    others
        Of whole, thorax, abdomen, points with their surroundings, and named regions, shape (3 + points + named, 4400).
    points
        Number of points.
    """

    rows: FloatArray
    columns: FloatArray
    others: FloatArray
    points: int

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        for array in (self.rows, self.columns, self.others):
            frozen(array)

    def shares(self, seen: FloatArray | BoolArray) -> FloatArray:
        """Return the seen share of every region, 0 to 1, shape (cells + 3 + points + named,).

        Parameters
        ----------
        seen
            Whether each sampled point was seen, or the share of several frames in which it was, shape (88, 50).
        """
        compiled = FramePath.kernels
        if compiled is None or seen.dtype != np.bool_:
            return self._shares(seen.astype(np.float32))
        shares = np.empty(len(self.rows) * self.columns.shape[1] + len(self.others), dtype=np.float32)
        compiled.seen_shares(np.ascontiguousarray(seen), self.rows, self.columns, self.others, 10.0**DIGITS, shares)
        shares.setflags(write=False)
        return shares

    def _shares(self, share: FloatArray) -> FloatArray:
        """Compute them with numpy."""
        cells = self.rows @ share @ self.columns
        shares = np.concatenate([cells.ravel(), self.others @ share.ravel()])
        return frozen(np.clip(np.round(shares, DIGITS), 0.0, 1.0))  # so that all of a region is 1

    def by_region(self, shares: FloatArray) -> SeenShares:
        """Return the shares of all regions, in the order of `engine.motion.stages.regions.RegionMeans`, by signal."""
        cells = len(self.rows) * self.columns.shape[1]
        points_from = cells + len(WIDE)
        whole, thorax, abdomen = shares[cells:points_from].tolist()
        return SeenShares(
            whole=whole,
            thorax=thorax,
            abdomen=abdomen,
            cells=shares[:cells].reshape(len(self.rows), -1),
            points=shares[points_from : points_from + self.points],
            named=shares[points_from + self.points :],
        )


def of_regions(seen: SeenShares) -> FloatArray:
    """Return the shares by signal as one vector, in the order of `engine.motion.stages.regions.RegionMeans`."""
    return np.concatenate([seen.cells.ravel(), (seen.whole, seen.thorax, seen.abdomen), seen.points, seen.named])


def prepare_seen_weights(layout: RegionLayout) -> SeenWeights:
    """Compute the weights of the sampled points in the regions of a layout."""
    grid_shape(layout.cell_px)
    thorax = thorax_coverage(layout.split)
    surfaces = [
        np.ones_like(thorax),
        thorax,
        1.0 - thorax,
        *(_surroundings(row, column) for row, column in layout.points),
        *(coverage(region.vertices) for region in layout.named),
    ]
    return SeenWeights(
        rows=_cell_weights(ROI_ROWS, layout.cell_px),
        columns=np.ascontiguousarray(_cell_weights(ROI_COLUMNS, layout.cell_px).T),
        others=np.stack([_at_samples(surface) for surface in surfaces]),
        points=len(layout.points),
    )


def _surroundings(row: int, column: int) -> FloatArray:
    """Return the square around a point, cut at the edges of the grid, shape (350, 200)."""
    reach = POINT_SURROUNDINGS_PX // 2
    around = np.zeros((ROI_ROWS, ROI_COLUMNS))
    around[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1] = 1.0
    return around


def _starts(size: int) -> npt.NDArray[np.intp]:
    """Return the first grid pixel that is nearest to each sampled one, shape (sampled,)."""
    return np.maximum(np.arange(0, size, STRIDE_PX) - STRIDE_PX // 2, 0)


def _at_samples(surface: FloatArray) -> FloatArray:
    """Sum weights on the grid, shape (350, 200), at the nearest sampled points, normalised, shape (4400,)."""
    sums = np.add.reduceat(np.add.reduceat(surface, _starts(ROI_ROWS), axis=0), _starts(ROI_COLUMNS), axis=1)
    assert sums.shape == SAMPLED_SHAPE
    return np.asarray((sums / sums.sum()).ravel(), dtype=np.float32)


def _cell_weights(size: int, cell_px: int) -> FloatArray:
    """Return the weight of each sampled row or column in each of the cells along it, shape (cells, sampled)."""
    pixels = np.arange(size) // cell_px == np.arange(-(-size // cell_px))[:, None]
    sums = np.add.reduceat(pixels.astype(np.float64), _starts(size), axis=1)
    return np.asarray(sums / sums.sum(axis=1, keepdims=True), dtype=np.float32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reference:
    """The reference position of the patient, stored as depths, so that it is independent of the model.

    Attributes
    ----------
    regions_mm
        Mean depth of every region [mm], in the order of `engine.motion.stages.regions.RegionMeans`.
    plane_mm
        Depth of the plane that volumes are measured from [mm].
    volume_l
        Volume between the reference surface and that plane [l].
    seen_shares
        How much of every region was seen when it was set, 0 to 1; the rest was extrapolated.
    surface_mm
        The region's surface at its nodes in the depth camera's frame [mm], shape (nodes, 3).
    uncertainty_mm
        Its standard uncertainty, root mean square over the points [mm]; NaN where the model does not know its errors.
    """

    regions_mm: FloatArray
    plane_mm: float
    volume_l: float
    seen_shares: FloatArray
    surface_mm: FloatArray
    uncertainty_mm: float = math.nan

    def volume_above_l(self, surface: FloatArray) -> float:
        """Volume of a surface relative to the reference [l]; vertices of shape (nodes, 3) [mm]."""
        return volume_l(surface, _TRIANGLES, self.plane_mm) - self.volume_l


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PreparedModel:
    """A model with its projection basis, its regions' means and weights, and its surface at the nodes.

    Attributes
    ----------
    node_mean_mm, node_modes
        Mean surface [mm] and each mode at the nodes, shapes (nodes,) and (k + e, nodes).
    beside
        What the independent checks have learned from the same frames, which only they read; None where nothing.
    """

    model: MotionModel
    basis: Basis
    regions: RegionMeans
    seen_weights: SeenWeights
    node_mean_mm: FloatArray
    node_modes: FloatArray
    beside: object = None

    def node_depth_mm(self, coefficients: FloatArray) -> FloatArray:
        """Depth at the nodes [mm], shape (nodes,), for coefficients of shape (k + e,)."""
        return np.asarray(self.node_mean_mm + coefficients @ self.node_modes)

    def depths_mm(self, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the depth at the nodes and of the regions [mm], for coefficients of shape (k + e,)."""
        compiled, regions = FramePath.kernels, self.regions
        if compiled is None:
            return self.node_depth_mm(coefficients), regions.depth_mm(coefficients)
        nodes_mm, regions_mm = np.empty(len(self.node_mean_mm)), np.empty(len(regions.mean_mm))
        compiled.depths(
            coefficients,
            self.node_mean_mm,
            self.node_modes,
            regions.mean_mm,
            regions.modes,
            regions.is_known,
            nodes_mm,
            regions_mm,
        )
        return nodes_mm, regions_mm

    def reference(self, coefficients: FloatArray, surface: FloatArray, seen_shares: FloatArray) -> Reference:
        """Return the reference at these coefficients.

        Parameters
        ----------
        surface
            Its vertices [mm], shape (nodes, 3).
        seen_shares
            How much of every region was seen, 0 to 1.
        """
        regions_mm = self.regions.model_depth_mm(coefficients)
        plane_mm = float(surface[:, 2].mean())
        return Reference(
            regions_mm=frozen(regions_mm),
            plane_mm=plane_mm,
            volume_l=volume_l(surface, _TRIANGLES, plane_mm),
            seen_shares=seen_shares,
            surface_mm=frozen(surface),
            uncertainty_mm=self.model.zero_error_mm(coefficients),
        )


def prepare_model(model: MotionModel, layout: RegionLayout) -> PreparedModel:
    """Precompute projection basis, region means and node surfaces of a model."""
    modes = modes_of(model)  # 7 MB, which nothing needs later
    basis = prepare_basis(model, modes)
    return PreparedModel(
        model=model,
        basis=basis,
        regions=prepare_regions(model.mean_mm, modes, model.known, layout),
        seen_weights=prepare_seen_weights(layout),
        node_mean_mm=frozen(at_nodes(model.mean_mm)),
        node_modes=frozen(np.stack([at_nodes(mode) for mode in modes])),
    )
