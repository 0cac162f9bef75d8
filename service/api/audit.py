"""The audit log: read it, take it along, and prove that nobody changed it."""

from typing import Annotated

from fastapi import APIRouter, Query, Response
from fastapi.responses import StreamingResponse
from pydantic import AwareDatetime

from service import deps
from service.api import problems
from service.audit import Outcome
from service.audit.export import MEDIA, ExportFormat, ExportRequest
from service.audit_schemas import AuditPage, AuditVerification
from service.errors import AuditBusyError, NotFoundError
from service.list_filters import AuditFilter
from service.schema_base import Identifier, Name

ACTION = r"^[a-z_]+\.[a-z_]+$"
router = APIRouter(prefix="/audit", tags=["audit"])
NDJSON = {media: {"schema": {"type": "string"}} for media in MEDIA.values()}


@router.get("")
def list_audit(
    services: deps.Offered,
    pages: deps.Pages100,
    session_id: Annotated[Identifier | None, Query(description="Only what belongs to this session")] = None,
    action: Annotated[str | None, Query(pattern=ACTION, max_length=40, description="Only this action")] = None,
    actor: Annotated[Name | None, Query(description="Only what this person or key did, or asked for")] = None,
    outcome: Annotated[Outcome | None, Query(description="Only what ended so")] = None,
    since: deps.Since = None,
    until: deps.Until = None,
) -> AuditPage:
    """List audit rows, newest first."""
    wanted = AuditFilter(action=action, actor=actor, outcome=outcome, since=since, until=until)
    return pages.told(services.audit.page(pages.cursor, pages.limit, session_id, wanted))


@router.get("/verify", responses=problems(NotFoundError, AuditBusyError))
def verify_audit(
    services: deps.Offered,
    after: Annotated[int, Query(ge=0, le=2**53, description="Go on after this row, which held")] = 0,
    limit: Annotated[int, Query(ge=1, le=1_000_000, description="Most rows to walk")] = 100_000,
) -> AuditVerification:
    """Walk the chain of hashes, and hold it against the heads kept outside; names the first broken row."""
    return services.audit.verify(after, limit)


@router.get(
    "/export",
    response_class=Response,
    responses={200: {"description": "One row a line", "content": NDJSON}, **problems(NotFoundError)},
)
def export_audit(
    services: deps.Offered,
    caller: deps.Caller,
    form: Annotated[ExportFormat, Query(alias="format", description="JSON lines, or FHIR R4 AuditEvents")],
    since: Annotated[AwareDatetime | None, Query(description="From this time on")] = None,
    until: Annotated[AwareDatetime | None, Query(description="Before this time")] = None,
    session_id: Annotated[Identifier | None, Query(description="Only what belongs to this session")] = None,
    *,
    with_patients: Annotated[bool, Query(description="FHIR resources name the patient's reference")] = False,
) -> StreamingResponse:
    """Export the audit, streamed; the export is audited itself."""
    request = ExportRequest(format=form, since=since, until=until, session_id=session_id, with_patients=with_patients)
    pieces = services.audit.export(request, caller.name)
    headers = {"Content-Disposition": f'attachment; filename="tidegate-audit.{form.value}.ndjson"'}
    return StreamingResponse(pieces, media_type=MEDIA[form], headers=headers)
