"""Mesh files: PLY (binary little-endian) and Wavefront OBJ, in mm, in the depth camera's frame."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engine.core.errors import InvalidValueError
from engine.core.files import write_whole
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, Measurement
from engine.motion.stages.surface import Mesh, surface_mesh

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
class MeshOptions:
    """Frames to save as a mesh, and the file format, ``ply`` or ``obj``."""

    frames: frozenset[int] = frozenset()
    kind: str = "ply"

    def __post_init__(self) -> None:
        """Check format, number and indices of the frames; raise InvalidValueError."""
        if self.kind not in FORMATS:
            raise InvalidValueError("mesh-format", self.kind, f"one of {', '.join(FORMATS)}")
        if len(self.frames) > MAX_MESHES:
            raise InvalidValueError("mesh", f"{len(self.frames)} frames", f"at most {MAX_MESHES}")
        for frame in self.frames:
            if frame < 0:
                raise InvalidValueError("mesh", frame, "frames from 0")


class MeshSaver:
    """Writes the meshes of the selected frames to a folder."""

    def __init__(self, out: Path, options: MeshOptions) -> None:
        self._out, self._options = out, options
        self.saved: list[str] = []
        """Names of the files written."""

    def save(self, measurement: Measurement) -> None:
        """Write a frame's mesh if it is selected and was measured."""
        motion = measurement.motion
        if motion is None or measurement.frame_index not in self._options.frames:
            return
        name = f"mesh_{measurement.frame_index:06d}.{self._options.kind}"
        save_mesh(surface_mesh(motion.surface_mm, NODE_ROWS, NODE_COLUMNS), self._out / name)
        self.saved.append(name)


def ply_bytes(mesh: Mesh) -> bytes:
    """Return a mesh as PLY, binary little-endian, coordinates in single precision [mm]."""
    faces = np.empty(len(mesh.triangles), dtype=[("count", "u1"), ("indices", "<i4", 3)])
    faces["count"], faces["indices"] = 3, mesh.triangles
    header = _PLY_HEADER.format(vertices=len(mesh.vertices_mm), faces=len(faces))
    return header.encode("ascii") + mesh.vertices_mm.astype("<f4").tobytes() + faces.tobytes()


def obj_text(mesh: Mesh) -> str:
    """Return a mesh as Wavefront OBJ [mm]; its indices count from one."""
    lines = ["# tidegate: depth camera frame, mm, x right, y down, z away from the camera"]
    lines += [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in mesh.vertices_mm.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.triangles + 1).tolist()]
    return "\n".join(lines) + "\n"


def save_mesh(mesh: Mesh, path: Path) -> None:
    """Write a mesh atomically; the suffix ``.ply`` or ``.obj`` selects the format."""
    content = ply_bytes(mesh) if path.suffix == ".ply" else obj_text(mesh).encode("ascii")
    write_whole(path, content)
