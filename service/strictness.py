"""What is checked of a request before its route looks at it: that its parameters are known, and its answer wanted.

A parameter that is misspelt and ignored is an export without its bound: unknown ones are refused by name.
"""

from collections.abc import Iterable, Iterator
from typing import Any

from fastapi import Request
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from pydantic import BaseModel

from service.access.identity import RULE
from service.access.rules import TAKES_PERMISSION_AWAY
from service.errors import BoundError, NotAcceptableError

MAY_HAVE_MORE = frozenset({"/login/oidc", "/login/oidc/return"})
"""Where a provider sends a browser to, with whatever parameters it likes."""
PROBLEM = "application/problem+json"


async def require_known_query(request: Request) -> None:
    """Refuse a parameter that the call does not have, or has twice; what takes the beam away is done all the same."""
    route = request.scope.get("route")
    if not isinstance(route, APIRoute) or route.path_format in MAY_HAVE_MORE or takes_beam_away(request):
        return
    known = _query_names(route)
    given = [name for name, _ in request.query_params.multi_items()]
    for name in given:
        if name not in known:
            bound = f"one of {', '.join(sorted(known))}" if known else "left out: this call has no parameters"
            msg = "there is no such parameter"
            raise BoundError(msg, field=name[:80], value="given", bound=bound)
        if given.count(name) > 1:
            msg = f"{name} is given more than once"
            raise BoundError(msg, field=name, value=f"{given.count(name)} times", bound="given once")


async def require_acceptable(request: Request) -> None:
    """Refuse to answer with what is not wanted; what takes the beam away is done whatever is wanted."""
    accept = request.headers.get("accept")
    if accept is None or takes_beam_away(request):
        return
    offered = _offered(request.scope.get("route"))
    if offered and not any(_matches(wanted, offered) for wanted in accept.split(",")):
        bound = " or ".join(offered)
        msg = f"Accept must let in {bound}"
        raise NotAcceptableError(msg, field="Accept", value=accept, bound=bound)


def _query_names(route: APIRoute) -> frozenset[str]:
    return frozenset(_walk(route.dependant))


def _walk(dependant: Dependant) -> Iterator[str]:
    """Walk the names of the parameters of a call, and of whatever it depends on."""
    for field in dependant.query_params:
        model = field.field_info.annotation
        if isinstance(model, type) and issubclass(model, BaseModel):  # each of its fields is a parameter
            yield from (told.alias or name for name, told in model.model_fields.items())
        else:
            yield field.alias
    for further in dependant.dependencies:
        yield from _walk(further)


def _offered(route: Any) -> tuple[str, ...]:  # noqa: ANN401 - whatever the router found
    """Return what a call answers with where that is known: documented, or JSON by its model."""
    if not isinstance(route, APIRoute):
        return ()
    content = [
        media for status, told in route.responses.items() if _is_good(status) for media in told.get("content", ())
    ]
    if content:
        return tuple(dict.fromkeys(content))
    return ("application/json",) if route.response_field is not None else ()


def _is_good(status: int | str) -> bool:
    return str(status).startswith("2")


def takes_beam_away(request: Request) -> bool:
    """Whether this call takes permission away, by the rule that let it in."""
    return request.scope.get(RULE) in TAKES_PERMISSION_AWAY


def _matches(wanted: str, offered: Iterable[str]) -> bool:
    """Whether one part of an Accept header lets in what is offered; what is weighed at nothing does not."""
    media, *parameters = (part.strip().lower() for part in wanted.split(";"))
    if any(parameter.replace(" ", "") in {"q=0", "q=0.0", "q=0.00", "q=0.000"} for parameter in parameters):
        return False
    kinds = {one.partition("/")[0] for one in offered}
    return media in {"*/*", "*", PROBLEM, *offered} or any(media == f"{kind}/*" for kind in kinds)
