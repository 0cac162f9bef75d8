"""Learned motion models: list, look at the spectrum, learn again, go back to one."""

from fastapi import APIRouter

from engine.errors import CommandRefusedError, ModelError, ModelMismatchError, TrainingRefusedError
from service import deps, schemas
from service.api import problems
from service.conditional import etag_of
from service.errors import EngineTimeoutError, NotFoundError, OperatorMismatchError, SessionStateError
from service.model_schemas import Model, ModelPage, Spectrum

router = APIRouter(tags=["models"])
READ = problems(NotFoundError)
ACT = problems(
    NotFoundError,
    OperatorMismatchError,
    SessionStateError,
    CommandRefusedError,
    ModelError,
    ModelMismatchError,
    TrainingRefusedError,
    EngineTimeoutError,
)


@router.get("/sessions/{session_id}/models", responses=READ)
def list_session_models(session_id: deps.SessionId, services: deps.Offered, pages: deps.Pages50) -> ModelPage:
    """List a session's models, newest first."""
    return pages.told(services.models.page(session_id, pages.cursor, pages.limit))


@router.post("/sessions/{session_id}/models/retrain", status_code=202, name="model.retrain", responses=ACT)
def retrain_model(
    session_id: deps.SessionId,
    request: schemas.RetrainRequest,
    caller: deps.Caller,
    services: deps.Offered,
    if_match: deps.IfMatch,
) -> schemas.SessionDetail:
    """Learn a new model in the background; it takes over between two frames, or waits while the session is armed."""
    with services.revisions.only_if(session_id, if_match):
        return services.runner.retrain(
            session_id, caller.acts_as(request.operator), keeps_reference=request.keeps_reference
        )


@router.post("/sessions/{session_id}/models/apply", name="model.apply", responses=ACT)
def apply_model(
    session_id: deps.SessionId,
    request: schemas.OperatorRequest,
    caller: deps.Caller,
    services: deps.Offered,
    if_match: deps.IfMatch,
) -> schemas.SessionDetail:
    """Let the new model that waits take over now; disarms. Refused when none waits."""
    with services.revisions.only_if(session_id, if_match):
        return services.runner.apply_model(session_id, caller.acts_as(request.operator))


@router.get("/models/{model_id}", responses=READ)
def read_model(model_id: deps.ModelId, services: deps.Offered, fresh: deps.IfNoneMatch) -> Model:
    """Read a model."""
    model = services.models.get(model_id)
    return fresh.told(model, etag_of("model", model.id, model.sha256, model.is_active))


@router.get("/models/{model_id}/spectrum", responses=READ)
def read_spectrum(model_id: deps.ModelId, services: deps.Offered) -> Spectrum:
    """Tell how much of the motion each component explains."""
    return services.models.spectrum(model_id)


@router.post("/models/{model_id}/activate", name="model.activate", responses=ACT)
def activate_model(
    model_id: deps.ModelId,
    request: schemas.OperatorRequest,
    caller: deps.Caller,
    services: deps.Offered,
    if_match: deps.IfMatch,
) -> schemas.SessionDetail:
    """Measure with this model of the running session once the zero is carried over to it; disarms."""
    operator = caller.acts_as(request.operator)
    if not if_match.is_given:
        return services.runner.activate(model_id, operator)
    with services.revisions.only_if(services.models.get(model_id).session_id, if_match):
        return services.runner.activate(model_id, operator)
