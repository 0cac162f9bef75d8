"""How the application answers errors: as problems; a refused call that would have changed something is audited."""

import logging

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import TypeAdapter, ValidationError
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException

from engine.errors import TidegateError
from service.access.identity import identity_in
from service.deps import services
from service.errors import MediaTypeError, NotAcceptableError, OperatorMismatchError, PreconditionFailedError
from service.problems import problem_of, problem_response
from service.schema_base import Identifier

logger = logging.getLogger(__name__)
SECRET_ACTIONS = frozenset({"user.login", "user.password"})
"""What is sent with these is never shown again, nor written down."""
SESSION_ID: TypeAdapter[str] = TypeAdapter(Identifier)


def install_problem_handlers(app: FastAPI) -> None:
    """Answer every error of the application as a problem."""
    app.add_exception_handler(TidegateError, _answer)
    app.add_exception_handler(SQLAlchemyError, _answer)
    app.add_exception_handler(MediaTypeError, _answer_refused)
    app.add_exception_handler(OperatorMismatchError, _answer_refused)
    app.add_exception_handler(PreconditionFailedError, _answer_refused)
    app.add_exception_handler(NotAcceptableError, _answer_refused)
    app.add_exception_handler(RequestValidationError, _answer_refused)
    app.add_exception_handler(HTTPException, _answer_refused)
    app.add_exception_handler(Exception, _answer)


async def _answer(_request: Request, error: Exception) -> JSONResponse:
    """Answer on the event loop: what becomes of a hold waits for no worker thread either."""
    problem = problem_of(error)
    if problem.status >= 500:
        logger.warning("answered %d %s (%s)", problem.status, problem.code, type(error).__name__)
    return problem_response(problem, getattr(error, "headers", None))


# A plain function: Starlette runs it in a worker thread, where it may write to the audit.
def _answer_refused(request: Request, error: Exception) -> JSONResponse:
    """Answer what was refused before any service was asked, so that none has audited it."""
    problem = problem_of(error)
    action = getattr(request.scope.get("route"), "name", None)
    if action in SECRET_ACTIONS:
        problem = problem.model_copy(update={"value": None, "errors": None})  # it may be a password
    identity = identity_in(request.scope)
    if identity is not None and request.method in {"POST", "PUT", "PATCH"} and action is not None and "." in action:
        services(request).audit.refused(
            actor=identity.name, action=action, session_id=_session_id(request), problem=problem
        )
    return problem_response(problem, getattr(error, "headers", None))


def _session_id(request: Request) -> str | None:
    try:
        return SESSION_ID.validate_python(request.path_params.get("session_id"))
    except ValidationError:
        return None
