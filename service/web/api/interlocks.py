"""Route of the interlocks."""

from fastapi import APIRouter

from service.core.schemas.gate import InterlockList
from service.web import dependencies

router = APIRouter(prefix="/interlocks", tags=["interlocks"])


@router.get("")
def list_interlocks(services: dependencies.AppServices) -> InterlockList:
    """List all interlocks, with the condition that trips each and the site settings that limit it."""
    return services.interlocks.interlocks()
