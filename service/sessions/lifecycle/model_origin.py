"""The origin that a learned motion model is stored with: patient, source and software."""

from engine import __version__
from engine.core.provenance import MAX_TEXT, ModelOrigin
from service.core.schemas import sessions
from service.engine_host.roles import SessionPlan

SOFTWARE = f"tidegate {__version__}"


def model_origin(plan: SessionPlan) -> ModelOrigin:
    """Return the origin of models learned in this session; the writer adds the time when it stores one."""
    camera = plan.source.uri if isinstance(plan.source, sessions.DeviceSource) else None
    source = camera or "camera" if plan.recording is None else plan.recording.name
    return ModelOrigin(patient=plan.patient_reference, source=source[-MAX_TEXT:], software=SOFTWARE)
