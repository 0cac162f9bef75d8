"""Learned motion models: list, look at the spectrum, learn again, go back to one."""

from fastapi import APIRouter

from service import deps, schemas
from service.api import problems

router = APIRouter(tags=["models"])
READ = problems(404, 422, 503)
ACT = problems(404, 409, 413, 415, 422, 503)


@router.get("/sessions/{session_id}/models", responses=READ)
def list_models(
    session_id: deps.SessionId, services: deps.Offered, cursor: deps.Cursor = None, limit: deps.Limit = 50
) -> schemas.ModelPage:
    """List a session's models, newest first."""
    return services.models.page(session_id, cursor, limit)


@router.post("/sessions/{session_id}/models/retrain", status_code=202, name="model.retrain", responses=ACT)
def retrain_model(
    session_id: deps.SessionId, request: schemas.OperatorRequest, services: deps.Offered
) -> schemas.SessionDetail:
    """Learn a new model in the background; when it takes over, the session is disarmed."""
    return services.runner.retrain(session_id, request.operator)


@router.get("/models/{model_id}", responses=READ)
def read_model(model_id: deps.ModelId, services: deps.Offered) -> schemas.Model:
    """Read a model."""
    return services.models.get(model_id)


@router.get("/models/{model_id}/spectrum", responses=READ)
def read_spectrum(model_id: deps.ModelId, services: deps.Offered) -> schemas.Spectrum:
    """Tell how much of the motion each component explains."""
    return services.models.spectrum(model_id)


@router.post("/models/{model_id}/activate", name="model.activate", responses=ACT)
def activate_model(
    model_id: deps.ModelId, request: schemas.OperatorRequest, services: deps.Offered
) -> schemas.SessionDetail:
    """Measure with this model of the running session from the next frame on; disarms."""
    return services.runner.activate(model_id, request.operator)
