"""Meshes as files that anything opens: PLY, binary little-endian, and Wavefront OBJ. Lengths are mm."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engine.errors import InvalidValueError
from engine.frames import Measurement
from engine.stages.roi import NODE_COLUMNS, NODE_ROWS
from engine.stages.surface import Mesh, surface_mesh
from engine.whole_files import write_whole

MAX_MESHES = 1000
FORMATS = ("ply", "obj")

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


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshWishes:
    """Of which frames a mesh is wanted, and as what kind of file."""

    frames: frozenset[int] = frozenset()
    kind: str = "ply"

    def __post_init__(self) -> None:
        """Refuse what cannot be done."""
        if self.kind not in FORMATS:
            raise InvalidValueError("mesh-format", self.kind, f"one of {', '.join(FORMATS)}")
        if len(self.frames) > MAX_MESHES:
            raise InvalidValueError("mesh", f"{len(self.frames)} frames", f"at most {MAX_MESHES}")
        for frame in self.frames:
            if frame < 0:
                raise InvalidValueError("mesh", frame, "frames from 0")


class MeshSaver:
    """Writes the meshes that are wanted as their frames come by."""

    def __init__(self, out: Path, wishes: MeshWishes) -> None:
        self._out, self._wishes = out, wishes
        self.saved: list[str] = []
        """Names of the files written."""

    def save(self, measurement: Measurement) -> None:
        """Write a frame's mesh if it is wanted and there is one."""
        motion = measurement.motion
        if motion is None or measurement.frame_index not in self._wishes.frames:
            return
        name = f"mesh_{measurement.frame_index:06d}.{self._wishes.kind}"
        save_mesh(surface_mesh(motion.surface_mm, NODE_ROWS, NODE_COLUMNS), self._out / name)
        self.saved.append(name)


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
    write_whole(path, lambda file: file.write(content))
