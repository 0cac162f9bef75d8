"""The surface as a mesh, and the volume under it (article, sections 4.4.2 and 4.5.1, equation 8).

Vertices are points of the depth camera's frame in mm. The article cuts the prism between a triangle and its projection
on the reference plane into three tetrahedra; their sum is the triangle's projected area times the mean height of its
corners, which is what is computed here.
"""

import numpy as np
import numpy.typing as npt

from engine.frames import FloatArray

MM3_PER_L = 1_000_000.0


def grid_triangles(rows: int, columns: int) -> npt.NDArray[np.intp]:
    """Cut a grid of vertices into triangles, shape (2 (rows - 1) (columns - 1), 3).

    Winding is the same everywhere: counter-clockwise in (column, row) axes, so normals point along +z.
    """
    vertex = np.arange(rows * columns).reshape(rows, columns)
    corner, right, below, across = vertex[:-1, :-1], vertex[:-1, 1:], vertex[1:, :-1], vertex[1:, 1:]
    upper = np.stack([corner, right, across], axis=-1)
    lower = np.stack([corner, across, below], axis=-1)
    return np.concatenate([upper.reshape(-1, 3), lower.reshape(-1, 3)])


def vertices_mm(rays: FloatArray, depth_mm: FloatArray) -> FloatArray:
    """Push depth camera rays (x/z, y/z), shape (N, 2), out to a depth [mm], shape (N,): points, shape (N, 3)."""
    return np.column_stack([rays * depth_mm[:, None], depth_mm])


def volume_l(vertices: FloatArray, triangles: npt.NDArray[np.intp], plane_mm: float) -> float:
    """Volume between a surface and the plane at depth ``plane_mm`` [l]; what rises above the plane is positive."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    area = 0.5 * ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))
    height = plane_mm - (a[:, 2] + b[:, 2] + c[:, 2]) / 3.0
    return float(area @ height) / MM3_PER_L
