"""Cameras that could be used."""

from fastapi import APIRouter

from service import deps, schemas
from service.api import problems
from service.errors import EngineProcessError

router = APIRouter(prefix="/devices", tags=["devices"])


@router.get("", responses=problems(EngineProcessError))
def list_devices(services: deps.Offered) -> schemas.DeviceList:
    """List the cameras the OpenNI2 runtime sees."""
    return services.engine.devices()
