"""Routes of the audit log: read, verify, export."""

from typing import Annotated

from fastapi import APIRouter, Query, Response
from fastapi.responses import StreamingResponse
from pydantic import AwareDatetime

from service.core.list_filters import AuditFilter
from service.core.schemas.base import Identifier, Name
from service.storage.audit import Outcome
from service.storage.audit.export import MEDIA, ExportRequest
from service.storage.audit.log import AuditPage, AuditVerification
from service.web import dependencies

ACTION = r"^[a-z_]+\.[a-z_]+$"
router = APIRouter(prefix="/audit", tags=["audit"])
NDJSON = {MEDIA: {"schema": {"type": "string"}}}


@router.get("")
def list_audit(
    services: dependencies.AppServices,
    pages: dependencies.Pages100,
    session_id: Annotated[Identifier | None, Query(description="Only rows of this session")] = None,
    action: Annotated[
        str | None, Query(pattern=ACTION, max_length=40, description="Only rows with this action")
    ] = None,
    actor: Annotated[Name | None, Query(description="Only rows of this person or key")] = None,
    outcome: Annotated[Outcome | None, Query(description="Only rows with this outcome")] = None,
    since: dependencies.Since = None,
    until: dependencies.Until = None,
) -> AuditPage:
    """List audit rows, newest first."""
    wanted = AuditFilter(action=action, actor=actor, outcome=outcome, since=since, until=until)
    return pages.answer(services.audit.page(pages.cursor, pages.limit, session_id, wanted))


@router.get("/verify")
def verify_audit(
    services: dependencies.AppServices,
    after: Annotated[int, Query(ge=0, le=2**53, description="Continue after this verified row")] = 0,
    limit: Annotated[int, Query(ge=1, le=1_000_000, description="Maximum number of rows to verify")] = 100_000,
) -> AuditVerification:
    """Verify the hash chain and compare it with the anchors outside the database; names the first broken row."""
    return services.audit.verify(after, limit)


@router.get(
    "/export",
    response_class=Response,
    responses={200: {"description": "One row per line", "content": NDJSON}},
)
def export_audit(
    services: dependencies.AppServices,
    caller: dependencies.Caller,
    since: Annotated[AwareDatetime | None, Query(description="From this time, inclusive")] = None,
    until: Annotated[AwareDatetime | None, Query(description="Until this time, exclusive")] = None,
    session_id: Annotated[Identifier | None, Query(description="Only rows of this session")] = None,
    *,
    with_patients: Annotated[bool, Query(description="Include details that name a patient")] = True,
) -> StreamingResponse:
    """Export the audit log as a stream of JSON lines; the export is recorded in the audit log."""
    request = ExportRequest(since=since, until=until, session_id=session_id, with_patients=with_patients)
    pieces = services.audit.export(request, caller.name)
    headers = {"Content-Disposition": 'attachment; filename="tidegate-audit.ndjson"'}
    return StreamingResponse(pieces, media_type=MEDIA, headers=headers)
