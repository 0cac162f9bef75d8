"""Routes of motion models: list, read, spectrum, quality maps, train again, activate."""

from typing import Annotated

from fastapi import APIRouter, Query

from service.core.conditional import etag_of
from service.core.schemas import sessions
from service.core.schemas.base import Identifier
from service.core.schemas.records import Model, ModelPage, ModelSimilarity, QualityMaps, Spectrum
from service.web import dependencies
from service.web.operator_calls import Operated

router = APIRouter(tags=["models"])
OtherModel = Annotated[Identifier, Query(description="The model that it is compared with")]


@router.get("/sessions/{session_id}/models")
def list_session_models(
    session_id: dependencies.SessionId, services: dependencies.AppServices, pages: dependencies.Pages50
) -> ModelPage:
    """List a session's models, newest first."""
    return pages.answer(services.models.page(session_id, pages.cursor, pages.limit))


@router.post("/sessions/{session_id}/models/retrain", status_code=202, name="model.retrain")
def retrain_model(
    session_id: dependencies.SessionId, request: sessions.RetrainRequest, call: Operated
) -> sessions.SessionDetail:
    """Train a new model in the background; applied between two frames, or on request while armed."""
    with call.acting(session_id, request.operator) as operator:
        return call.commands.retrain(session_id, operator, keeps_reference=request.keeps_reference)


@router.post("/sessions/{session_id}/models/apply", name="model.apply")
def apply_model(
    session_id: dependencies.SessionId, request: sessions.OperatorRequest, call: Operated
) -> sessions.SessionDetail:
    """Apply the new model that is waiting; disarms. Refused if none is waiting."""
    with call.acting(session_id, request.operator) as operator:
        return call.commands.apply_model(session_id, operator)


@router.get("/models/{model_id}")
def read_model(
    model_id: dependencies.ModelId, services: dependencies.AppServices, fresh: dependencies.IfNoneMatch
) -> Model:
    """Read a model."""
    model = services.models.get(model_id)
    return fresh.answer(model, etag_of("model", model.id, model.sha256, model.is_active))


@router.get("/models/{model_id}/spectrum")
def read_spectrum(model_id: dependencies.ModelId, services: dependencies.AppServices) -> Spectrum:
    """Return the share of the motion that each component explains."""
    return services.models.spectrum(model_id)


@router.get("/models/{model_id}/quality-maps")
def read_quality_maps(model_id: dependencies.ModelId, services: dependencies.AppServices) -> QualityMaps:
    """Return the deepest breath of the training, measured and reconstructed, and the map of the residuals."""
    return services.models.quality_maps(model_id)


@router.get("/models/{model_id}/similarity")
def read_similarity(
    model_id: dependencies.ModelId, services: dependencies.AppServices, other: OtherModel
) -> ModelSimilarity:
    """Compare a model with another one of the same patient, such as that of an earlier fraction."""
    return services.models.similarity(model_id, other)


@router.post("/models/{model_id}/activate", name="model.activate")
def activate_model(
    model_id: dependencies.ModelId,
    request: sessions.OperatorRequest,
    caller: dependencies.Caller,
    services: dependencies.AppServices,
    if_match: dependencies.IfMatch,
) -> sessions.SessionDetail:
    """Activate a model of the running session, after the reference is transferred to it; disarms."""
    operator = caller.checked_actor(request.operator)
    if not if_match.is_given:
        return services.runner.commands.activate(model_id, operator)
    with services.revisions.only_if(services.models.get(model_id).session_id, if_match):
        return services.runner.commands.activate(model_id, operator)
