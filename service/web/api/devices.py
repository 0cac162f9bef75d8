"""Routes of the connected cameras."""

from fastapi import APIRouter

from service.core.schemas import sessions
from service.web import dependencies

router = APIRouter(prefix="/devices", tags=["devices"])


@router.get("")
def list_devices(services: dependencies.AppServices) -> sessions.DeviceList:
    """List the connected cameras."""
    return services.engine.devices()
