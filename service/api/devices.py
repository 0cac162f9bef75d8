"""Cameras that could be used."""

from fastapi import APIRouter

from service import deps, schemas

router = APIRouter(prefix="/devices", tags=["devices"])


@router.get("")
def list_devices(services: deps.Offered) -> schemas.DeviceList:
    """List the cameras the OpenNI2 runtime sees."""
    return services.engine.devices()
