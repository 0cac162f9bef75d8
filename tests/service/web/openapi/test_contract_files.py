"""The contracts in the repository are the application's, complete, and hold what they promise."""

import pytest

from service.web.openapi import contract_files
from tests.support.contract.document import contract_app
from tests.support.repository import ROOT

APP = contract_app()
DOCUMENT = APP.openapi()
OPERATIONS = [
    (method, path, operation) for path, item in DOCUMENT["paths"].items() for method, operation in item.items()
]
POSTS = {
    "/api/v1/calibrations",
    "/api/v1/sessions",
    "/api/v1/sessions/{session_id}/start",
    "/api/v1/sessions/{session_id}/note",
    "/api/v1/sessions/{session_id}/send",
    "/api/v1/sessions/{session_id}/simulation",
    "/api/v1/sessions/{session_id}/signature",
    "/api/v1/sessions/{session_id}/arm",
    "/api/v1/sessions/{session_id}/disarm",
    "/api/v1/sessions/{session_id}/reference",
    "/api/v1/sessions/{session_id}/position-check",
    "/api/v1/sessions/{session_id}/countersign",
    "/api/v1/sessions/{session_id}/acknowledge",
    "/api/v1/sessions/{session_id}/hold",
    "/api/v1/sessions/{session_id}/release",
    "/api/v1/sessions/{session_id}/presence",
    "/api/v1/sessions/{session_id}/baseline-correction",
    "/api/v1/sessions/{session_id}/window",
    "/api/v1/sessions/{session_id}/stop",
    "/api/v1/sessions/{session_id}/models/retrain",
    "/api/v1/sessions/{session_id}/models/apply",
    "/api/v1/models/{model_id}/activate",
    "/api/v1/plans",
    "/api/v1/plans/{plan_id}/sessions",
    "/api/v1/qa/runs",
    "/api/v1/qa/runs/{run_id}/cancel",
    "/api/v1/login",
    "/api/v1/logout",
    "/api/v1/me/password",
    "/api/v1/me/logins/{login_id}/end",
    "/api/v1/users",
    "/api/v1/users/{name}/logins/{login_id}/end",
    "/api/v1/keys",
    "/api/v1/keys/{key_id}/revoke",
    "/api/v1/coach/code",
    "/api/v1/coach/pair",
    "/api/v1/coach/screens/{screen_id}/end",
}
PATCHES = {"/api/v1/users/{name}"}
PUTS = {"/api/v1/qa/baseline", "/api/v1/sessions/{session_id}/coaching"}


@pytest.mark.parametrize("name", ["openapi.json", "live.schema.json", "coach.schema.json"])
def test_the_committed_contract_is_the_application_s(name):
    committed = (ROOT / "openapi" / name).read_text(encoding="utf-8")
    assert contract_files(APP)[name] == committed, "run `tidegate openapi --out openapi/` and look at what changed"


def test_these_are_all_the_calls_that_change_something():
    assert {path for method, path, _ in OPERATIONS if method == "post"} == POSTS
    assert {path for method, path, _ in OPERATIONS if method == "put"} == PUTS
    assert {path for method, path, _ in OPERATIONS if method == "patch"} == PATCHES
    assert {method for method, _, _ in OPERATIONS} == {"get", "post", "put", "patch"}


def test_every_reference_leads_somewhere():
    def references(value):
        if isinstance(value, dict):
            for key, part in value.items():
                if key == "$ref":
                    yield part
                else:
                    yield from references(part)
        elif isinstance(value, list):
            for part in value:
                yield from references(part)

    known = {f"#/components/{kind}/{name}" for kind, parts in DOCUMENT["components"].items() for name in parts}
    assert set(references(DOCUMENT)) <= known
