"""A motion model made ready for frames: everything that is linear in the coefficients, worked out once.

It is prepared in the trainer's thread, so that the swap between two frames costs the engine thread nothing.
"""

from dataclasses import dataclass

import numpy as np

from engine.frames import FloatArray, frozen
from engine.model import MotionModel
from engine.stages.projection import Basis, prepare_basis
from engine.stages.regions import RegionLayout, RegionMeans, prepare_regions
from engine.stages.roi import NODE_COLUMNS, NODE_ROWS, at_nodes
from engine.stages.surface import grid_triangles, volume_l

_TRIANGLES = grid_triangles(NODE_ROWS, NODE_COLUMNS)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reference:
    """The patient's position that counts as zero: depths, so that it outlives the model it came from.

    Attributes
    ----------
    regions_mm
        Mean depth of every region [mm], in the order of :class:`engine.stages.regions.RegionMeans`.
    plane_mm
        Depth of the plane that volumes are measured from [mm].
    volume_l
        Volume between the reference surface and that plane [l].
    """

    regions_mm: FloatArray
    plane_mm: float
    volume_l: float

    def volume_above_l(self, surface: FloatArray) -> float:
        """Volume of a surface, vertices (nodes, 3), against the reference [l]."""
        return volume_l(surface, _TRIANGLES, self.plane_mm) - self.volume_l


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ActiveModel:
    """A model with its basis, its regions' means and its surface at the region's nodes.

    Attributes
    ----------
    node_mean_mm, node_modes
        The mean surface and each mode at the nodes, shapes (nodes,) and (k + e, nodes).
    """

    model: MotionModel
    basis: Basis
    regions: RegionMeans
    node_mean_mm: FloatArray
    node_modes: FloatArray

    def node_depth_mm(self, coefficients: FloatArray) -> FloatArray:
        """Depth at the region's nodes [mm], shape (nodes,)."""
        return np.asarray(self.node_mean_mm + coefficients @ self.node_modes)

    def reference(self, coefficients: FloatArray, surface: FloatArray) -> Reference:
        """Make the position that these coefficients mean the zero; ``surface`` are its vertices (nodes, 3)."""
        regions_mm = self.regions.model_depth_mm(coefficients)
        plane_mm = float(surface[:, 2].mean())
        return Reference(
            regions_mm=frozen(regions_mm), plane_mm=plane_mm, volume_l=volume_l(surface, _TRIANGLES, plane_mm)
        )


def prepare_model(model: MotionModel, layout: RegionLayout) -> ActiveModel:
    """Make a model ready to be measured with in the regions of ``layout``."""
    basis = prepare_basis(model)
    return ActiveModel(
        model=model,
        basis=basis,
        regions=prepare_regions(model.mean_mm, basis.modes, model.known, layout),
        node_mean_mm=frozen(at_nodes(model.mean_mm)),
        node_modes=frozen(np.stack([at_nodes(mode) for mode in basis.modes])),
    )
