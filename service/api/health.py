"""Is the process there, and could a session run."""

from fastapi import APIRouter, Response

from service import deps
from service.readiness_schemas import Health, Readiness

router = APIRouter(tags=["health"])


@router.get("/healthz")
async def healthz() -> Health:
    """Answer while the process and its event loop live.

    Nothing else is looked at: whoever restarts what does not answer ends a session, and no disk or database that is in
    trouble is mended by that. Answered by the event loop itself, so that requests that wait keep it from nobody.
    """
    return Health(status="ok")


@router.get("/readyz", responses={503: {"model": Readiness, "description": "Something is missing"}})
def readyz(services: deps.Offered, response: Response) -> Readiness:
    """Say whether a session could run, and what is missing."""
    readiness = services.health.readiness()
    if not readiness.is_ready:
        response.status_code = 503
    return readiness
