"""Routes of the recordings that sessions may play."""

from fastapi import APIRouter

from service.core.schemas.records import RecordingPage
from service.web import dependencies

router = APIRouter(prefix="/recordings", tags=["recordings"])


@router.get("")
def list_recordings(services: dependencies.AppServices, pages: dependencies.Pages50) -> RecordingPage:
    """List the recordings in the site's folders, by path."""
    return pages.answer(services.recordings.page(pages.cursor, pages.limit))
