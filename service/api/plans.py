"""RT Plans: import, list, read, and prepare a session of a fraction."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Response

from engine.errors import CommandRefusedError, ModelMismatchError, RecordingError, RuntimeMissingError, SourceLostError
from service import deps
from service.api import problems
from service.conditional import etag_of
from service.errors import (
    BoundError,
    EngineProcessError,
    NotFoundError,
    OperatorMismatchError,
    QaActiveError,
    ServiceStoppingError,
    SessionActiveError,
    StorageLowError,
)
from service.plan_schemas import Plan, PlanPage, PlanSessionRequest, PreparedSession
from service.plans import errors
from service.schema_base import Name

router = APIRouter(prefix="/plans", tags=["plans"])
IMPORT: dict[int | str, dict[str, Any]] = {
    200: {"model": Plan, "description": "It was there already, and says the same"},
    **problems(
        errors.PlanError,
        errors.PlanFormatError,
        errors.PlanTruncatedError,
        errors.PlanKindError,
        errors.PlanBoundError,
        errors.PlanConflictError,
        errors.PlanBusyError,
        OperatorMismatchError,
    ),
}
PREPARE = problems(
    NotFoundError,
    BoundError,
    OperatorMismatchError,
    RecordingError,
    SessionActiveError,
    QaActiveError,
    ModelMismatchError,
    CommandRefusedError,
    RuntimeMissingError,
    SourceLostError,
    StorageLowError,
    ServiceStoppingError,
    EngineProcessError,
    errors.PlanGatingError,
    errors.PlanRejectedError,
    errors.PlanContradictedError,
    errors.FractionDoneError,
    errors.OverrideNotPersonalError,
)
FILE = {
    "requestBody": {
        "required": True,
        "description": (
            "One DICOM file (PS3.10) of RT Plan Storage or RT Ion Plan Storage, in implicit or explicit little endian, "
            "explicit big endian, or deflated. Nothing of it is kept but what the answer tells."
        ),
        "content": {"application/dicom": {"schema": {}}},
    }
}
PatientFilter = Annotated[Name | None, Query(description="Plans of this patient only")]
LabelFilter = Annotated[Name | None, Query(description="Plans of this label only")]


@router.post("", status_code=201, name="plan.import", responses=IMPORT, openapi_extra=FILE)
def import_plan(
    body: deps.PlanFile,
    caller: deps.Caller,
    services: deps.Offered,
    response: Response,
    operator: deps.OperatorName = "",
    idempotency_key: deps.IdempotencyKey = None,
) -> Plan:
    """Read an RT Plan and keep what it says; the same plan again answers with the one that is there, and 200."""
    kept = services.plans.keep(body, caller.acts_as(operator), idempotency_key)
    if kept.is_replay:
        response.status_code = 200
    return kept.answer


@router.get("", responses=problems(BoundError))
def list_plans(
    services: deps.Offered,
    pages: deps.Pages50,
    patient_reference: PatientFilter = None,
    label: LabelFilter = None,
) -> PlanPage:
    """List plans, newest first."""
    page = services.plans.page(pages.cursor, pages.limit, patient_reference=patient_reference, label=label)
    return pages.told(page)


@router.get("/{plan_id}", responses=problems(NotFoundError))
def read_plan(plan_id: deps.PlanId, services: deps.Offered, fresh: deps.IfNoneMatch) -> Plan:
    """Read a plan: fractions, beams, what it prescribes about breathing, and whether a later file contradicts it."""
    plan = services.plans.detail(plan_id)
    contradicted = "" if plan.contradicted is None else plan.contradicted.created_at.isoformat()
    return fresh.told(plan, etag_of("plan", plan_id, contradicted))


@router.post("/{plan_id}/sessions", status_code=201, name="session.create", responses=PREPARE)
def prepare_session(
    plan_id: deps.PlanId,
    request: PlanSessionRequest,
    caller: deps.Caller,
    services: deps.Offered,
    response: Response,
    idempotency_key: deps.IdempotencyKey = None,
) -> PreparedSession:
    """Create a session of a fraction of this plan; patient, plan and fraction are the plan's."""
    kept = services.planned_sessions.prepare(plan_id, request, caller, idempotency_key)
    if kept.is_replay:
        response.headers["Idempotency-Replayed"] = "true"
    return kept.answer
