"""Routes for liveness and readiness."""

from fastapi import APIRouter, Response

from service.core.schemas.base import Health, Machine, Readiness
from service.web import dependencies

router = APIRouter(tags=["health"])
machine_router = APIRouter(tags=["health"])


@router.get("/healthz")
async def healthz() -> Health:
    """Answer 200 while the process and its event loop run.

    Disk and database are not checked: an orchestrator that restarts the process would end the session and repair
    neither. The answer comes from the event loop, so it does not wait for busy worker threads.
    """
    return Health(status="ok")


@router.get("/readyz", responses={503: {"model": Readiness, "description": "A session cannot run"}})
def readyz(services: dependencies.AppServices, response: Response) -> Readiness:
    """Return whether a session can run, and what prevents it."""
    readiness = services.health.readiness()
    if not readiness.is_ready:
        response.status_code = 503
    return readiness


@machine_router.get("/machine")
def read_machine(services: dependencies.AppServices) -> Machine:
    """Return what runs on this machine: versions, settings in force, disk, certificate, readiness."""
    return services.machine.describe()
