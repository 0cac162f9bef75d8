"""Who is claimed to ask, read from a body that may say anything: what takes permission away is not refused over one.

A person's name comes from the log-in; a machine's body says for whom it acts, where it says so legibly. The rest is
passed over, and told in fixed words: what a body says is never copied to where a hold has to be written down.
"""

import json
from typing import NamedTuple

from pydantic import TypeAdapter, ValidationError

from service.access.calling import NOT_GIVEN
from service.schema_base import Name

OPERATOR = "operator"
NAME: TypeAdapter[str] = TypeAdapter(Name)


class Claim(NamedTuple):
    """Who is claimed to ask, and what was not read; None where all was."""

    operator: str = NOT_GIVEN
    unread: str | None = None


def read_claim(body: bytes) -> Claim:
    """Read what can be read."""
    if not body:
        return Claim()
    try:
        said = json.loads(body)
    except (ValueError, RecursionError):
        return Claim(unread="it is no JSON")
    if not isinstance(said, dict):
        return Claim(unread="it is no object")
    try:
        operator = NAME.validate_python(said.get(OPERATOR, NOT_GIVEN), strict=True) if OPERATOR in said else NOT_GIVEN
    except ValidationError:
        return Claim(unread="its operator is no name")
    return Claim(operator=operator, unread="it has other fields" if said.keys() - {OPERATOR} else None)
