"""Which row each route writes (docs/3-operate/audit.md): ``python -m tests.support.documents.audit_routes`` prints it.

With ``--write`` it is put into the document instead.
"""

from functools import cache, partial
from typing import Any

from fastapi.routing import APIRoute, iter_route_contexts

from tests.support.contract.document import contract_app
from tests.support.generated_sections import print_or_write
from tests.support.repository import ROOT

DOCUMENT = ROOT / "docs" / "3-operate" / "audit.md"
UNSAFE = ("post", "put", "patch", "delete")
NOT_AUDITED = {("POST", "/api/v1/sessions/{session_id}/presence"): "sent every second by a displayed page"}
EXPORTS = {
    "/api/v1/audit/export": "audit.export",
    "/api/v1/sessions/{session_id}/samples": "samples.export",
    "/api/v1/qa/runs/{run_id}/report.pdf": "qa.export",
    "/api/v1/sessions/{session_id}/report.pdf": "report.export",
    "/api/v1/sessions/{session_id}/report.html": "report.export",
    "/api/v1/sessions/{session_id}/waveform.dcm": "report.export",
    "/api/v1/sessions/{session_id}/report.dcm": "report.export",
}
"""What leaves the house by GET."""


@cache
def operations() -> dict[tuple[str, str], dict[str, Any]]:
    """Every route there is, by method and path."""
    paths = contract_app().openapi()["paths"]
    return {(method.upper(), path): one for path, methods in paths.items() for method, one in methods.items()}


@cache
def route_names() -> dict[str, str]:
    """The name of each route, by the operation's id, which is its function's name."""
    routes = [context.route for context in iter_route_contexts(contract_app().routes)]
    return {route.endpoint.__name__: route.name for route in routes if isinstance(route, APIRoute)}


def action_of(operation: dict[str, Any]) -> str:
    """The name of a route that changes something is its action."""
    return route_names()[operation["operationId"]]


def audited() -> dict[tuple[str, str], str]:
    """Every route that writes a row, with its action."""
    found = {
        place: action_of(operation)
        for place, operation in operations().items()
        if place[0].lower() in UNSAFE and place not in NOT_AUDITED
    }
    return found | {("GET", path): action for path, action in EXPORTS.items()}


def route_table() -> str:
    """One row a route."""
    head = ["| route | action |", "|---|---|"]
    rows = [f"| {method} `{path}` | `{action}` |" for (method, path), action in sorted(audited().items(), key=_by_path)]
    rows += [f"| {method} `{path}` | none: {why} |" for (method, path), why in NOT_AUDITED.items()]
    return "\n".join(head + rows)


def _by_path(item: tuple[tuple[str, str], str]) -> tuple[str, str]:
    return item[0][1], item[0][0]


MADE = {"routes": route_table}
main = partial(print_or_write, DOCUMENT, MADE)


if __name__ == "__main__":
    main()
