"""How the application answers errors: as problems; a refused call that would have changed something is audited."""

import logging

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import TypeAdapter, ValidationError
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException

from engine.errors import TidegateError
from service.deps import services
from service.errors import MediaTypeError, problem_of, problem_response
from service.schema_base import Identifier, Name

logger = logging.getLogger(__name__)
NAME: TypeAdapter[str] = TypeAdapter(Name)
SESSION_ID: TypeAdapter[str] = TypeAdapter(Identifier)


def install_problem_handlers(app: FastAPI) -> None:
    """Answer every error of the application as a problem."""
    app.add_exception_handler(TidegateError, _answer)
    app.add_exception_handler(SQLAlchemyError, _answer)
    app.add_exception_handler(MediaTypeError, _answer_refused)
    app.add_exception_handler(RequestValidationError, _answer_refused)
    app.add_exception_handler(HTTPException, _answer_refused)
    app.add_exception_handler(Exception, _answer)


# Plain functions: Starlette runs them in a worker thread, where they may write to the audit.
def _answer(_request: Request, error: Exception) -> JSONResponse:
    problem = problem_of(error)
    if problem.status >= 500:
        logger.warning("answered %d %s (%s)", problem.status, problem.code, type(error).__name__)
    return problem_response(problem)


def _answer_refused(request: Request, error: Exception) -> JSONResponse:
    """Answer what was refused before any service was asked, so that none has audited it."""
    problem = problem_of(error)
    action = getattr(request.scope.get("route"), "name", None)
    if request.method in {"POST", "PUT"} and action is not None and "." in action:
        services(request).audit.refused(
            actor=_actor(request, error), action=action, session_id=_session_id(request), problem=problem
        )
    return problem_response(problem, getattr(error, "headers", None))


def _actor(request: Request, error: Exception) -> str:
    body = getattr(error, "body", None)
    claimed = body.get("operator") if isinstance(body, dict) else request.query_params.get("operator")
    try:
        return NAME.validate_python(claimed)
    except ValidationError:
        return "unknown"


def _session_id(request: Request) -> str | None:
    try:
        return SESSION_ID.validate_python(request.path_params.get("session_id"))
    except ValidationError:
        return None
