"""Error handlers: errors become problems; refused calls that would have changed data are audited."""

import logging

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import TypeAdapter, ValidationError
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException

from engine.core.errors import TidegateError
from service.access.request.identity import identity_in
from service.core.errors import MediaTypeError, NotAcceptableError, OperatorMismatchError, PreconditionFailedError
from service.core.schemas.base import Identifier
from service.web.dependencies import services
from service.web.problems.table import problem_of, problem_response

logger = logging.getLogger(__name__)
SECRET_ACTIONS = frozenset({"user.login", "user.password", "screen.pair", "session.countersign", "session.signature"})
"""Problems of these routes never repeat the values that were sent: they may contain passwords or codes."""
SESSION_ID: TypeAdapter[str] = TypeAdapter(Identifier)


def install_problem_handlers(app: FastAPI) -> None:
    """Install the handlers that answer every error as a problem."""
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
    """Answer on the event loop, so that the answer to a hold does not wait for a worker thread."""
    problem = problem_of(error)
    if problem.status >= 500:
        logger.warning("answered %d %s (%s)", problem.status, problem.code, type(error).__name__)
    return problem_response(problem, getattr(error, "headers", None))


# A plain function: Starlette runs it in a worker thread, where it may write to the audit.
def _answer_refused(request: Request, error: Exception) -> JSONResponse:
    """Answer a call that was refused before a service saw it, and audit the refusal."""
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
