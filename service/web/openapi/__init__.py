"""The OpenAPI document: FastAPI's document of the routes, completed with what all calls share.

`operations` adds access rules, problems and headers, `contract_files` writes the files in `openapi/`. What many calls
share stands once, in the components.
"""

from typing import Any

from fastapi import FastAPI
from fastapi.routing import APIRoute

from service.core.schemas.base import Problem
from service.web.openapi.operations import (
    HEADERS,
    RESPONSES,
    SECURITY_SCHEMES,
    TAGS,
    complete_operation,
    contract_files,
    write_contracts,
)

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
    components["responses"] = RESPONSES
    components["parameters"] = {}
    document["tags"] = TAGS
    document["servers"] = [{"url": "/", "description": "The service that answers this document"}]
    for path, item in document["paths"].items():
        for method, operation in item.items():
            complete_operation(operation, method.upper(), path)
            _share_parameters(operation, components["parameters"])
    _drop_titles(components["schemas"])
    _drop_empty_operator(components["schemas"])
    for unused in ("HTTPValidationError", "ValidationError"):
        components["schemas"].pop(unused, None)


def _share_parameters(operation: dict[str, Any], shared: dict[str, Any]) -> None:
    """Replace parameters that have the same words everywhere by references; FastAPI writes their words twice."""
    for number, parameter in enumerate(operation.get("parameters", ())):
        schema = parameter["schema"]
        schema.pop("title", None)
        if schema.get("description") == parameter.get("description"):
            schema.pop("description", None)
        name = parameter["name"]
        if shared.setdefault(name, parameter) == parameter:
            operation["parameters"][number] = {"$ref": f"#/components/parameters/{name}"}


def _drop_titles(schemas_: dict[str, Any]) -> None:
    """Remove the titles that Pydantic makes from the names of fields."""
    for schema in schemas_.values():
        for part in schema.get("properties", {}).values():
            part.pop("title", None)


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
