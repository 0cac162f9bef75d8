"""Checks before the route: all query parameters are known, and the answer's media type is acceptable.

Unknown parameters are refused: a misspelt one that is ignored would be an export without its limit.
"""

from collections.abc import Iterable, Iterator
from typing import Any

from fastapi import Request
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from pydantic import BaseModel

from service.access.request.identity import RULE
from service.access.request.rules import TAKES_PERMISSION_AWAY
from service.core.errors import BoundError, NotAcceptableError

MAY_HAVE_MORE = frozenset({"/login/oidc", "/login/oidc/return"})
"""Route of the identity provider's redirect, which may have any parameters."""
PROBLEM = "application/problem+json"


async def require_known_query(request: Request) -> None:
    """Refuse unknown and repeated parameters, except for hold, disarm and stop."""
    route = request.scope.get("route")
    if not isinstance(route, APIRoute) or route.path_format in MAY_HAVE_MORE or takes_beam_away(request):
        return
    known = _query_names(route)
    given = [name for name, _ in request.query_params.multi_items()]
    for name in given:
        if name not in known:
            bound = f"one of {', '.join(sorted(known))}" if known else "left out: this call has no query parameters"
            msg = "unknown parameter"
            raise BoundError(msg, field=name[:80], value="given", bound=bound)
        if given.count(name) > 1:
            msg = f"{name} is given more than once"
            raise BoundError(msg, field=name, value=f"{given.count(name)} times", bound="given once")


async def require_acceptable(request: Request) -> None:
    """Refuse a call whose media types the client does not accept, except for hold, disarm and stop."""
    accept = request.headers.get("accept")
    if accept is None or takes_beam_away(request):
        return
    offered = _offered(request.scope.get("route"))
    if offered and not any(_matches(wanted, offered) for wanted in accept.split(",")):
        bound = " or ".join(offered)
        msg = f"Accept must include {bound}"
        raise NotAcceptableError(msg, field="Accept", value=accept, bound=bound)


def _query_names(route: APIRoute) -> frozenset[str]:
    return frozenset(_walk(route.dependant))


def _walk(dependant: Dependant) -> Iterator[str]:
    """Yield the names of a call's parameters, including those of its dependencies."""
    for field in dependant.query_params:
        model = field.field_info.annotation
        if isinstance(model, type) and issubclass(model, BaseModel):  # each of its fields is a parameter
            yield from (parameter.alias or name for name, parameter in model.model_fields.items())
        else:
            yield field.alias
    for further in dependant.dependencies:
        yield from _walk(further)


def _offered(route: Any) -> tuple[str, ...]:  # noqa: ANN401 - whatever the router found
    """Return the media types of a call's answer: documented ones, or JSON for a model; empty if unknown."""
    if not isinstance(route, APIRoute):
        return ()
    content = [
        media
        for status, response in route.responses.items()
        if _is_good(status)
        for media in response.get("content", ())
    ]
    if content:
        return tuple(dict.fromkeys(content))
    return ("application/json",) if route.response_field is not None else ()


def _is_good(status: int | str) -> bool:
    return str(status).startswith("2")


def takes_beam_away(request: Request) -> bool:
    """Whether the call is hold, disarm or stop, by its access rule."""
    return request.scope.get(RULE) in TAKES_PERMISSION_AWAY


def _matches(wanted: str, offered: Iterable[str]) -> bool:
    """Whether one part of an Accept header matches an offered type; q=0 does not."""
    media, *parameters = (part.strip().lower() for part in wanted.split(";"))
    if any(parameter.replace(" ", "") in {"q=0", "q=0.0", "q=0.00", "q=0.000"} for parameter in parameters):
        return False
    kinds = {one.partition("/")[0] for one in offered}
    return media in {"*/*", "*", PROBLEM, *offered} or any(media == f"{kind}/*" for kind in kinds)
