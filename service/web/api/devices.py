"""Routes of the connected cameras."""

from fastapi import APIRouter

from service.core.errors import EngineProcessError
from service.core.schemas import sessions
from service.web import dependencies
from service.web.api import problems

router = APIRouter(prefix="/devices", tags=["devices"])


@router.get("", responses=problems(EngineProcessError))
def list_devices(services: dependencies.AppServices) -> sessions.DeviceList:
    """List the connected cameras."""
    return services.engine.devices()
