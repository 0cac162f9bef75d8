"""The surface as a mesh, and the volume under it (article, sections 4.4.2 and 4.5.1, equation 8).

Vertices are points of the depth camera's frame in mm: x right, y down, z away from the camera. The article cuts the
prism between a triangle and its projection on the reference plane into three tetrahedra; their sum is the triangle's
projected area times the mean height of its corners, which is what is computed here.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from engine.core.compiled import FramePath
from engine.core.frames import FloatArray, frozen

MM3_PER_L = 1_000_000.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mesh:
    """A triangle mesh of the surface.

    Attributes
    ----------
    vertices_mm
        Points of the depth camera's frame [mm], shape (n, 3), row by row from superior right.
    triangles
        Indices of vertices, shape (m, 3), counter-clockwise as seen by the camera, so that normals point out of the
        patient.
    """

    vertices_mm: FloatArray
    triangles: npt.NDArray[np.intp]

    def __post_init__(self) -> None:
        """Make both arrays read-only."""
        frozen(self.vertices_mm)
        frozen(self.triangles)


def surface_mesh(vertices: FloatArray, rows: int, columns: int) -> Mesh:
    """Make the mesh of a grid of vertices, shape (rows * columns, 3)."""
    return Mesh(vertices_mm=vertices, triangles=np.ascontiguousarray(grid_triangles(rows, columns)[:, ::-1]))


def grid_triangles(rows: int, columns: int) -> npt.NDArray[np.intp]:
    """Return the triangles of a grid of vertices, shape (2 (rows - 1) (columns - 1), 3).

    The winding is consistent, counter-clockwise in (column, row) axes, so normals point along +z.
    """
    vertex = np.arange(rows * columns).reshape(rows, columns)
    corner, right, below, across = vertex[:-1, :-1], vertex[:-1, 1:], vertex[1:, :-1], vertex[1:, 1:]
    upper = np.stack([corner, right, across], axis=-1)
    lower = np.stack([corner, across, below], axis=-1)
    return np.concatenate([upper.reshape(-1, 3), lower.reshape(-1, 3)])


def end_at_markers(nodes: FloatArray, rows: int, columns: int, share: float) -> FloatArray:
    """Move the last row and column of a grid of nodes inwards, to the markers.

    Parameters
    ----------
    nodes
        Values at each node, shape (rows * columns, k).
    share
        Position of the grid's end between the last but one (0) and the last node (1).
    """
    grid = nodes.reshape(rows, columns, -1).copy()
    grid[-1] = (1.0 - share) * grid[-2] + share * grid[-1]
    grid[:, -1] = (1.0 - share) * grid[:, -2] + share * grid[:, -1]
    return grid.reshape(rows * columns, -1)


def vertices_mm(rays: FloatArray, depth_mm: FloatArray) -> FloatArray:
    """Return the points at a depth [mm], shape (N,), on depth camera rays (x/z, y/z), shape (N, 2); shape (N, 3)."""
    return np.column_stack([rays * depth_mm[:, None], depth_mm])


def node_surface_mm(rays: FloatArray, depth_mm: FloatArray, rows: int, columns: int, share: float) -> FloatArray:
    """Return the vertices at the nodes' depth, with the last row and column moved to the markers: both of the above."""
    compiled = FramePath.kernels
    if compiled is None:
        return vertices_mm(end_at_markers(rays, rows, columns, share), depth_mm)
    vertices = np.empty((rows * columns, 3))
    compiled.node_surface(np.ascontiguousarray(rays), np.ascontiguousarray(depth_mm), columns, share, vertices)
    return vertices


def volume_l(vertices: FloatArray, triangles: npt.NDArray[np.intp], plane_mm: float) -> float:
    """Volume between a surface and the plane at depth ``plane_mm`` [l]; positive in front of the plane."""
    compiled = FramePath.kernels
    if compiled is None:
        return _volume_l(vertices, triangles, plane_mm)
    volume_mm3: float = compiled.mesh_volume(np.ascontiguousarray(vertices), triangles, plane_mm)
    return volume_mm3 / MM3_PER_L


def _volume_l(vertices: FloatArray, triangles: npt.NDArray[np.intp], plane_mm: float) -> float:
    """Compute it with numpy."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    area = 0.5 * ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))
    height = plane_mm - (a[:, 2] + b[:, 2] + c[:, 2]) / 3.0
    return float(area @ height) / MM3_PER_L
