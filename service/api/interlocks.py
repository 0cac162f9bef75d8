"""The interlocks: why a beam is held, and by which numbers of this site."""

from fastapi import APIRouter

from service import deps
from service.gate_schemas import InterlockList

router = APIRouter(prefix="/interlocks", tags=["interlocks"])


@router.get("")
def list_interlocks(services: deps.Offered) -> InterlockList:
    """List every reason to hold a beam, with what trips it and the site's settings that bound it."""
    return services.interlocks.interlocks()
