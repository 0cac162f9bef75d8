"""The newest frame's surface as a mesh, made when somebody asks for it: the engine knows nothing of that."""

from engine.live import LiveView
from engine.stages.roi import NODE_COLUMNS, NODE_ROWS
from engine.stages.surface import surface_mesh
from service import schemas
from service.errors import MeshMissingError
from service.live_view import known

DIGITS = 3


def mesh_answer(view: LiveView | None) -> schemas.SurfaceMesh:
    """Tell the surface of the newest frame; raise MeshMissingError where it was not measured."""
    measurement = None if view is None else view.record.measurement
    motion = None if measurement is None else measurement.motion
    if measurement is None or motion is None or len(motion.surface_mm) != NODE_ROWS * NODE_COLUMNS:
        msg = "the session does not run, or its newest frame was not measured"
        raise MeshMissingError(msg)
    mesh = surface_mesh(motion.surface_mm, NODE_ROWS, NODE_COLUMNS)
    return schemas.SurfaceMesh(
        frame_index=measurement.frame_index,
        timestamp_us=measurement.timestamp_us,
        rows=NODE_ROWS,
        columns=NODE_COLUMNS,
        volume_l=known(motion.volume_l),
        vertices_mm=mesh.vertices_mm.round(DIGITS).tolist(),
        triangles=mesh.triangles.tolist(),
    )
