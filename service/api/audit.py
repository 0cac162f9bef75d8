"""The audit log: read it, and prove that nobody changed it."""

from typing import Annotated

from fastapi import APIRouter, Query

from service import deps, schemas
from service.api import problems
from service.schema_base import Identifier

router = APIRouter(prefix="/audit", tags=["audit"])


@router.get("", responses=problems(422, 503))
def list_audit(
    services: deps.Offered,
    cursor: deps.Cursor = None,
    limit: deps.Limit = 100,
    session_id: Annotated[Identifier | None, Query(description="Only what belongs to this session")] = None,
) -> schemas.AuditPage:
    """List audit rows, newest first."""
    return services.audit.page(cursor, limit, session_id)


@router.get("/verify", responses=problems(503))
def verify_audit(services: deps.Offered) -> schemas.AuditVerification:
    """Walk the chain of hashes; names the first broken row when there is one."""
    return services.audit.verify()
