"""The OpenAPI document: FastAPI's document of the routes, completed with what all calls share.

`operations` adds access rules, problems and headers, `examples` adds requests and answers, `links` connects operations,
`contract_files` writes the files in `openapi/`.
"""

from typing import Any

from fastapi import FastAPI
from fastapi.routing import APIRoute

from service.core.schemas.problems import Problem
from service.web.openapi.components import HEADERS, SECURITY_SCHEMES, TAGS, problem_examples
from service.web.openapi.contract_files import contract_files, write_contracts
from service.web.openapi.examples import add_examples
from service.web.openapi.links import add_links
from service.web.openapi.operations import complete_operation

__all__ = ["contract_files", "describe_contract", "operation_id", "write_contracts"]


def operation_id(route: APIRoute) -> str:
    """Return the operation id: the name of the route's function. It is part of the contract."""
    return str(getattr(route.endpoint, "__name__", route.name))


def describe_contract(app: FastAPI) -> None:
    """Install the function that completes FastAPI's document of the application."""
    generate = app.openapi

    def openapi() -> dict[str, object]:
        is_made = app.openapi_schema is not None
        document = generate()
        if not is_made:
            _complete(document)
        return document

    app.openapi = openapi  # type: ignore[method-assign]  # FastAPI's documented way to extend the document


def _complete(document: dict[str, Any]) -> None:
    components = document.setdefault("components", {})
    components["schemas"] = components.get("schemas", {}) | _problem_schemas()
    components["securitySchemes"] = SECURITY_SCHEMES
    components["headers"] = HEADERS
    components["examples"] = problem_examples()
    document["tags"] = TAGS
    there_are = {operation["operationId"] for item in document["paths"].values() for operation in item.values()}
    for path, item in document["paths"].items():
        for method, operation in item.items():
            complete_operation(operation, method.upper(), path)
            add_examples(operation)
            add_links(operation, there_are)
    _drop_empty_operator(components["schemas"])
    for unused in ("HTTPValidationError", "ValidationError"):
        components["schemas"].pop(unused, None)


def _problem_schemas() -> dict[str, Any]:
    """Return the schemas of problems, which no route declares as its answer."""
    schema = Problem.model_json_schema(mode="serialization", ref_template="#/components/schemas/{model}")
    return {**schema.pop("$defs", {}), "Problem": schema}


def _drop_empty_operator(schemas_: dict[str, Any]) -> None:
    """Remove defaults that mean "left out" and that the field itself would refuse."""
    for schema in schemas_.values():
        operator = schema.get("properties", {}).get("operator", {})
        if operator.get("default") == "":
            del operator["default"]
