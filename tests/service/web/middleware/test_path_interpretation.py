"""Guard and router read a path each by themselves; should they ever differ, the call fails."""

import pytest
from starlette.requests import HTTPConnection
from starlette.routing import Route

from service.access.request.identity import RULE
from service.web.dependencies import require_guarded

SESSION = "/api/v1/sessions/{session_id}"


def connection(rule, *, method="GET", path="/api/v1/sessions/abc", route="/{session_id}", **parameters):
    scope = {
        "type": "http",
        "method": method,
        "path": path,
        "path_params": parameters or {"session_id": "abc"},
        "route": Route(route, lambda _request: None),
        "headers": [],
    }
    return HTTPConnection(scope | ({} if rule is None else {RULE: rule}))


def test_the_route_whose_rule_let_the_call_in_is_taken():
    require_guarded(connection(("GET", SESSION)))


@pytest.mark.parametrize(
    ("rule", "found"),
    [
        (None, {}),
        (("POST", SESSION), {}),
        (("GET", f"{SESSION}/samples"), {}),
        (("GET", "/api/v1/models/{model_id}"), {}),
        (("GET", "/api/v1/sessions/abc"), {}),
        (("GET", SESSION), {"route": "/{session_id}/samples"}),
        (("GET", SESSION), {"route": "/{model_id}", "model_id": "abc"}),
        (("GET", SESSION), {"session_id": "other"}),
        (("GET", SESSION), {"path": "/api/v1/sessions/abc/"}),
    ],
    ids=str,
)
def test_any_other_fails(rule, found):
    with pytest.raises(RuntimeError, match="reached another route"):
        require_guarded(connection(rule, **found))
