"""Routes of RT Plans: import, list, read, create a session of a fraction."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Response

from service.access.request.identity import NOT_GIVEN
from service.core.conditional import etag_of
from service.core.list_filters import PlanFilter
from service.core.schemas.base import Name
from service.core.schemas.plans import Plan, PlanPage, PlanSessionRequest, PreparedSession
from service.web import dependencies

router = APIRouter(prefix="/plans", tags=["plans"])
IMPORT: dict[int | str, dict[str, Any]] = {
    200: {"model": Plan, "description": "The plan is stored already, with the same content"},
}
FILE = {
    "requestBody": {
        "required": True,
        "description": (
            "One DICOM file (PS3.10) of RT Plan Storage or RT Ion Plan Storage, in implicit or explicit little endian, "
            "explicit big endian, or deflated. Only the content of the answer is stored."
        ),
        "content": {"application/dicom": {"schema": {}}, "application/octet-stream": {"schema": {}}},
    }
}
PatientFilter = Annotated[Name | None, Query(description="Only plans of this patient")]
LabelFilter = Annotated[Name | None, Query(description="Only plans with this label")]


@router.post("", status_code=201, name="plan.import", responses=IMPORT, openapi_extra=FILE)
def import_plan(
    body: dependencies.PlanFile,
    caller: dependencies.Caller,
    services: dependencies.AppServices,
    response: Response,
    operator: dependencies.OperatorName = None,
    idempotency_key: dependencies.IdempotencyKey = None,
) -> Plan:
    """Import an RT Plan; the same plan again returns the stored one with 200."""
    stored = services.plans.add(body, caller.checked_actor(operator or NOT_GIVEN), idempotency_key)
    if stored.is_replay:
        response.status_code = 200
    return stored.answer


@router.get("")
def list_plans(
    services: dependencies.AppServices,
    pages: dependencies.Pages50,
    patient_reference: PatientFilter = None,
    label: LabelFilter = None,
    search: Annotated[
        Name | None, Query(description="Only plans with this in the patient's reference or label")
    ] = None,
) -> PlanPage:
    """List plans, newest first, with the fraction that comes next and the newest session of each."""
    wanted = PlanFilter(patient_reference=patient_reference, label=label, search=search)
    return pages.answer(services.plans.page(pages.cursor, pages.limit, wanted))


@router.get("/{plan_id}")
def read_plan(
    plan_id: dependencies.PlanId, services: dependencies.AppServices, fresh: dependencies.IfNoneMatch
) -> Plan:
    """Read a plan: fractions, beams, respiratory technique, and whether a later file contradicts it."""
    plan = services.plans.detail(plan_id)
    contradicted = "" if plan.contradicted is None else plan.contradicted.created_at.isoformat()
    return fresh.answer(plan, etag_of("plan", plan_id, contradicted))


@router.post("/{plan_id}/sessions", status_code=201, name="session.create")
def prepare_session(
    plan_id: dependencies.PlanId,
    request: PlanSessionRequest,
    caller: dependencies.Caller,
    services: dependencies.AppServices,
    response: Response,
    idempotency_key: dependencies.IdempotencyKey = None,
) -> PreparedSession:
    """Create a session for a fraction of this plan; patient, plan and fraction come from the plan."""
    return dependencies.created(services.planned_sessions.prepare(plan_id, request, caller, idempotency_key), response)
