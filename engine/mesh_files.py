"""Meshes as files that anything opens: PLY, binary little-endian, and Wavefront OBJ. Lengths are mm."""

from pathlib import Path

import numpy as np

from engine.stages.surface import Mesh

_PLY_HEADER = """ply
format binary_little_endian 1.0
comment tidegate: depth camera frame, mm, x right, y down, z away from the camera
element vertex {vertices}
property float x
property float y
property float z
element face {faces}
property list uchar int vertex_indices
end_header
"""


def ply_bytes(mesh: Mesh) -> bytes:
    """Write a mesh as PLY, binary little-endian, coordinates in single precision."""
    faces = np.empty(len(mesh.triangles), dtype=[("count", "u1"), ("indices", "<i4", 3)])
    faces["count"], faces["indices"] = 3, mesh.triangles
    header = _PLY_HEADER.format(vertices=len(mesh.vertices_mm), faces=len(faces))
    return header.encode("ascii") + mesh.vertices_mm.astype("<f4").tobytes() + faces.tobytes()


def obj_text(mesh: Mesh) -> str:
    """Write a mesh as Wavefront OBJ; its indices count from one."""
    lines = ["# tidegate: depth camera frame, mm, x right, y down, z away from the camera"]
    lines += [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in mesh.vertices_mm.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.triangles + 1).tolist()]
    return "\n".join(lines) + "\n"


def save_mesh(mesh: Mesh, path: Path) -> None:
    """Write a mesh as the file's name says, ``.ply`` or ``.obj``; whole or not at all."""
    content = ply_bytes(mesh) if path.suffix == ".ply" else obj_text(mesh).encode("ascii")
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
