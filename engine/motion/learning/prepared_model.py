"""A motion model prepared for measuring: all quantities that are linear in the coefficients, precomputed.

Preparation runs in the trainer's thread, so the switch between two frames costs the engine thread no time.
"""

from dataclasses import dataclass

import numpy as np

from engine.core.compiled import kernels
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, FloatArray, frozen
from engine.core.motion_model import MotionModel
from engine.motion.learning.seen_shares import SeenWeights, prepare_seen_weights
from engine.motion.stages.projection import Basis, modes_of, prepare_basis
from engine.motion.stages.regions import RegionLayout, RegionMeans, prepare_regions
from engine.motion.stages.roi import at_nodes
from engine.motion.stages.surface import grid_triangles, volume_l

_TRIANGLES = grid_triangles(NODE_ROWS, NODE_COLUMNS)


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
    """

    regions_mm: FloatArray
    plane_mm: float
    volume_l: float
    seen_shares: FloatArray
    surface_mm: FloatArray

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
        compiled, regions = kernels(), self.regions
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
