"""What was sent to the PACS."""

from dataclasses import asdict

from fastapi import APIRouter

from service.core.schemas.reports import Sendings, SentSession
from service.web import dependencies

router = APIRouter(prefix="/pacs", tags=["sessions"])


@router.get("")
def list_sent(services: dependencies.AppServices) -> Sendings:
    """List the sessions that were sent to the PACS and those that wait, oldest first."""
    items = [SentSession.model_validate(asdict(one)) for one in services.outbox.all()]
    return Sendings(is_configured=bool(services.outbox.pacs), items=items)
