"""Base classes and shared types of the schemas: strict requests, answers, printable names."""

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StringConstraints
from pydantic_core import PydanticCustomError


def broken(field: str, value: object, bound: str) -> PydanticCustomError:
    """Return the validation error of a rule that spans several fields.

    `service.web.problems.table` reads field, value and bound from its context.
    """
    context = {"field": field, "value": value if isinstance(value, str) else repr(value), "bound": bound}
    return PydanticCustomError("inconsistent", "{field} must be {bound}", context)


def _printable(text: str) -> str:
    if not text.isprintable() or not text.strip():
        msg = "must be printable characters, not only spaces"
        raise ValueError(msg)
    return text


Name = Annotated[str, StringConstraints(min_length=1, max_length=80), AfterValidator(_printable)]
SourceText = Annotated[str, StringConstraints(min_length=1, max_length=1024), AfterValidator(_printable)]
Operator = Annotated[
    Name,
    Field(
        description="The responsible person. May be left out by a person who is logged in; an API key"
        " sends the name of the person it acts for",
        examples=["A. Therapist"],
    ),
]
Identifier = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{32}$")]


class Request(BaseModel):
    """Base of everything read from a client."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class Answer(BaseModel):
    """Base of every answer."""

    model_config = ConfigDict(frozen=True)
