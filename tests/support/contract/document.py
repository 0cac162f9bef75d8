"""The application's OpenAPI document: making it takes a second, so the modules of a process share one."""

from functools import cache
from typing import Any

from fastapi import FastAPI

from service.core.settings.settings import Settings
from service.web.app import create_app


@cache
def contract_app() -> FastAPI:
    """Return an application that is never started; it keeps its OpenAPI document once that is made."""
    return create_app(Settings())


def parameters_of(document: dict[str, Any], operation: dict[str, Any]) -> list[dict[str, Any]]:
    """Return an operation's parameters, those that it shares with others too."""
    shared = document.get("components", {}).get("parameters", {})
    return [shared[one["$ref"].rpartition("/")[2]] if "$ref" in one else one for one in operation.get("parameters", ())]
