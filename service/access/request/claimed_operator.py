"""Reads the operator from the body of hold, disarm and stop, which are never refused because of their body.

A person's name comes from the log-in; a machine's body may name the person for whom it acts. Everything else in the
body is ignored and reported in fixed words: the body's own text is never copied into the audit row of a hold.
"""

import json
from typing import NamedTuple

from pydantic import TypeAdapter, ValidationError

from service.access.request.caller import NOT_GIVEN
from service.core.schemas.base import Name

OPERATOR = "operator"
NAME: TypeAdapter[str] = TypeAdapter(Name)


class ClaimedOperator(NamedTuple):
    """The operator named in the body, and what part of the body was ignored; None if nothing was."""

    operator: str = NOT_GIVEN
    unread: str | None = None


def read_claim(body: bytes) -> ClaimedOperator:
    """Return the operator and what was ignored; never raises, whatever the body."""
    if not body:
        return ClaimedOperator()
    try:
        claim = json.loads(body)
    except (ValueError, RecursionError):
        return ClaimedOperator(unread="it is no JSON")
    if not isinstance(claim, dict):
        return ClaimedOperator(unread="it is no object")
    try:
        operator = NAME.validate_python(claim.get(OPERATOR, NOT_GIVEN), strict=True) if OPERATOR in claim else NOT_GIVEN
    except ValidationError:
        return ClaimedOperator(unread="its operator is no name")
    return ClaimedOperator(operator=operator, unread="it has other fields" if claim.keys() - {OPERATOR} else None)
