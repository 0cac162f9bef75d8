"""Is the process there, and could a session run."""

from fastapi import APIRouter, Response

from service import deps, schemas

router = APIRouter(tags=["health"])


@router.get("/healthz")
def healthz() -> schemas.Health:
    """Answer while the process lives."""
    return schemas.Health(status="ok")


@router.get("/readyz", responses={503: {"model": schemas.Readiness, "description": "Something is missing"}})
def readyz(services: deps.Offered, response: Response) -> schemas.Readiness:
    """Say whether a session could run, and what is missing."""
    readiness = services.health.readiness()
    if not readiness.is_ready:
        response.status_code = 503
    return readiness
