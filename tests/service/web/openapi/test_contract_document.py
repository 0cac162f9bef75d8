"""The contract is complete: every call has its id and its problems; everything that is sent is bounded."""

import json
import re

from openapi_spec_validator import OpenAPIV31SpecValidator, validate
from referencing import Registry, Resource
from referencing.jsonschema import DRAFT202012

from service.access.request.rules import RULES, SOCKET, TAKES_PERMISSION_AWAY
from service.web.api.route_problems import PROBLEMS
from service.web.openapi import contract_files
from service.web.openapi.operations import WITH_RETRY
from service.web.problems.catalogue import CATALOGUE
from tests.support.contract.document import contract_app, parameters_of
from tests.support.contract.schemas import Schema
from tests.support.repository import ROOT

DOCUMENT = contract_app().openapi()
OPERATIONS = [
    (method.upper(), path, operation) for path, item in DOCUMENT["paths"].items() for method, operation in item.items()
]
REGISTRY = Registry().with_resource("urn:contract", Resource(contents=DOCUMENT, specification=DRAFT202012))
NO_NUMBER = frozenset({"string", "boolean", "null", "object", "array"})
PEOPLE = "text/html"
REQUESTS = ROOT / "tests/support/contract/requests.json"


def validator(schema):
    """Validate against a schema that stands in the document."""
    return Schema(_absolute(schema), registry=REGISTRY)


def _absolute(schema):
    if isinstance(schema, dict):
        return {key: f"urn:contract{part}" if key == "$ref" else _absolute(part) for key, part in schema.items()}
    return [_absolute(part) for part in schema] if isinstance(schema, list) else schema


def test_ids_of_operations_are_unique_plain_words():
    ids = [operation["operationId"] for _, _, operation in OPERATIONS]
    assert len(ids) == len(set(ids))
    assert all(re.fullmatch(r"[a-z]+(_[a-z]+)*", one) for one in ids)


def test_every_call_that_has_a_rule_is_in_the_contract_and_no_other():
    reported = {(method, path) for method, path, _ in OPERATIONS}
    ruled = {call for call in RULES if call[0] not in {SOCKET, "HEAD"} and call[1] != "/api/v1/openapi.json"}
    assert reported == ruled
    assert PROBLEMS.keys() <= {(method, path.removeprefix("/api/v1")) for method, path, _ in OPERATIONS}


def test_a_call_has_one_tag_and_the_tag_is_explained(subtests):
    for _, _, operation in OPERATIONS:
        with subtests.test(operation["operationId"]):
            explained = {tag["name"] for tag in DOCUMENT["tags"] if tag["description"]}
            assert len(operation["tags"]) == 1
            assert set(operation["tags"]) <= explained


def test_examples_in_schemas_are_true(subtests):
    for name, schema in DOCUMENT["components"]["schemas"].items():
        with subtests.test(name):
            for example in schema.get("examples", ()):
                assert validator({"$ref": f"#/components/schemas/{name}"}).errors(example) == []


def test_the_tests_requests_keep_to_the_contract(subtests):
    by_id = {operation["operationId"]: operation for _, _, operation in OPERATIONS}
    for name, body in json.loads(REQUESTS.read_text(encoding="utf-8")).items():
        with subtests.test(name):
            schema = by_id[name]["requestBody"]["content"]["application/json"].get("schema", {})
            assert validator(schema).errors(body) == []


def test_the_document_is_small():
    assert len(contract_files(contract_app())["openapi.json"].encode()) < 395_000


def test_problems_are_reported_by_code_and_each_code_is_in_the_catalogue_with_that_status(subtests):
    for _, path, operation in OPERATIONS:
        with subtests.test(operation["operationId"]):
            for status, answer in operation["responses"].items():
                if status[0] not in "45" or PEOPLE in answer.get("content", {}) or (path, status) == ("/readyz", "503"):
                    assert status not in operation["x-problem-codes"]
                    continue
                codes = operation["x-problem-codes"][status]
                assert codes, f"{status}: name the errors, not the status"
                assert {CATALOGUE[code].status for code in codes} == {int(status)}
                shared = DOCUMENT["components"]["responses"][answer["$ref"].rpartition("/")[2]]
                assert set(shared["content"]) == {"application/problem+json"}
                assert ("Retry-After" in shared["headers"]) == bool(WITH_RETRY & set(codes))
                assert ("WWW-Authenticate" in shared["headers"]) == (status == "401")


def test_what_any_call_may_meet_is_documented(subtests):
    for method, path, operation in OPERATIONS:
        with subtests.test(operation["operationId"]):
            statuses = set(operation["responses"])
            assert {"421", "500"} <= statuses
            assert operation["security"] == [] or {"401", "403"} <= statuses or path.startswith("/api/v1/me")
            if "requestBody" in operation:
                is_obeyed = (method.upper(), path) in TAKES_PERMISSION_AWAY  # done whatever becomes of its body
                assert {"400", "422"} <= statuses
                assert ({"408", "413", "415"} & statuses) == (set() if is_obeyed else {"408", "413", "415"})
            if "{" in path:
                assert {"404", "422"} <= statuses


def test_parameters_and_headers_have_words_and_bounds(subtests):
    for _, _, operation in OPERATIONS:
        with subtests.test(operation["operationId"]):
            for parameter in parameters_of(DOCUMENT, operation):
                assert parameter.get("description") or parameter["in"] == "path" or PEOPLE in str(operation), parameter[
                    "name"
                ]
                assert unbounded(parameter["schema"], parameter["name"]) == []
            for answer in operation["responses"].values():
                assert "$ref" in answer or "X-Request-ID" in answer.get("headers", {})
    assert all("X-Request-ID" in answer["headers"] for answer in DOCUMENT["components"]["responses"].values())


def test_everything_that_is_sent_is_bounded(subtests):
    for _, _, operation in OPERATIONS:
        with subtests.test(operation["operationId"]):
            for media_type, part in operation.get("requestBody", {}).get("content", {}).items():
                # Two have readers of their own, which bound what they read; of an empty schema nothing is read.
                if operation["operationId"] not in {"upload_calibration", "import_plan"} and part["schema"] != {}:
                    assert unbounded(part["schema"], media_type) == []


def test_headers_that_are_taken_bring_their_problems_and_their_headers():
    """By name, so that nothing is worked out from a spelling that no parameter has."""
    paths = DOCUMENT["paths"]
    create = paths["/api/v1/sessions"]["post"]
    assert {"idempotency_key_reused", "idempotency_in_progress"} <= set(create["x-problem-codes"]["409"])
    assert {"Idempotency-Replayed"} <= create["responses"]["201"]["headers"].keys()
    session = paths["/api/v1/sessions/{session_id}"]["get"]["responses"]
    assert {"ETag"} <= session["200"]["headers"].keys() & session["304"]["headers"].keys()
    assert paths["/api/v1/sessions/{session_id}/arm"]["post"]["responses"]["412"]
    assert "412" not in paths["/api/v1/sessions/{session_id}/hold"]["post"]["responses"]
    assert "Link" in paths["/api/v1/sessions"]["get"]["responses"]["200"]["headers"]


def test_an_unbounded_field_is_noticed():
    assert unbounded({"type": "object", "properties": {"a": {"type": "string"}}}, "x") == ["x", "x.a"]
    assert unbounded({"type": "array", "items": {"type": "integer"}}, "x") == ["x", "x[]"]
    assert unbounded({"anyOf": [{"type": "number", "minimum": 0}, {"type": "null"}]}, "x") == ["x"]
    assert unbounded({"type": "string", "format": "binary-of-some-kind"}, "x") == ["x"]


def resolved(schema):
    """Follow a reference."""
    while "$ref" in schema:
        schema = DOCUMENT["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
    return schema


def unbounded(schema, name, seen=()):
    """Name everything in a schema that a client may make as large as it likes."""
    if "$ref" in schema:
        if schema["$ref"] in seen:
            return []
        return unbounded(resolved(schema), name, (*seen, schema["$ref"]))
    choices = [one for kind in ("anyOf", "oneOf", "allOf") for one in schema.get(kind, ())]
    if choices:
        return [found for one in choices for found in unbounded(one, name, seen)]
    if {"enum", "const"} & schema.keys():
        return []
    kind = schema.get("type")
    found = [] if _is_bounded(kind, schema) else [name]
    for key, part in schema.get("properties", {}).items():
        found += unbounded(part, f"{name}.{key}", seen)
    if kind == "array":
        found += unbounded(schema.get("items", {}), f"{name}[]", seen)
    return found


def _is_bounded(kind, schema):
    match kind:
        case "string":
            return "maxLength" in schema or "pattern" in schema or schema.get("format") in {"date-time", "uuid"}
        case "integer" | "number":
            low = schema.keys() & {"minimum", "exclusiveMinimum"}
            return bool(low) and bool(schema.keys() & {"maximum", "exclusiveMaximum"})
        case "array":
            return "maxItems" in schema
        case "object":
            return schema.get("additionalProperties") is False
        case _:
            return kind in NO_NUMBER


def test_the_contract_is_valid_by_the_specification():
    validate(json.loads((ROOT / "openapi" / "openapi.json").read_text()), cls=OpenAPIV31SpecValidator)
