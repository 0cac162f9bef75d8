"""The newest frame's surface as a mesh, computed in the service on request, never in the engine."""

from engine.control import LiveView
from engine.core.frames import NODE_COLUMNS, NODE_ROWS
from engine.motion.stages.surface import surface_mesh
from service.core.errors import MeshMissingError
from service.core.finite import finite_or_none
from service.core.schemas import sessions

DIGITS = 3


def mesh_answer(view: LiveView | None) -> sessions.SurfaceMesh:
    """Return the surface of the newest frame; raise MeshMissingError where it was not measured."""
    measurement = None if view is None else view.record.measurement
    motion = None if measurement is None else measurement.motion
    if measurement is None or motion is None or len(motion.surface_mm) != NODE_ROWS * NODE_COLUMNS:
        msg = "the session does not run, or its newest frame was not measured"
        raise MeshMissingError(msg)
    mesh = surface_mesh(motion.surface_mm, NODE_ROWS, NODE_COLUMNS)
    return sessions.SurfaceMesh(
        frame_index=measurement.frame_index,
        timestamp_us=measurement.timestamp_us,
        rows=NODE_ROWS,
        columns=NODE_COLUMNS,
        volume_l=finite_or_none(motion.volume_l),
        vertices_mm=mesh.vertices_mm.round(DIGITS).tolist(),
        triangles=mesh.triangles.tolist(),
    )
