"""The application's OpenAPI document: making it takes a second, so the modules of a process share one."""

from functools import cache

from fastapi import FastAPI

from service.core.settings.settings import Settings
from service.web.app import create_app


@cache
def contract_app() -> FastAPI:
    """Return an application that is never started; it keeps its OpenAPI document once that is made."""
    return create_app(Settings())
