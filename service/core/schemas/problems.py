"""Schemas of problems (RFC 9457)."""

from pydantic import Field

from service.core.schemas.base import Answer


class BrokenBound(Answer):
    """One value of a request that is outside its bound."""

    field: str = Field(examples=["window.lower_mm"])
    value: str = Field(examples=["-400.0"])
    bound: str = Field(examples=["at least -100"])


class Problem(Answer):
    """RFC 9457 problem with a stable code; with field, value and bound if a value broke a bound."""

    type: str = Field(examples=["urn:tidegate:problem:invalid_value"])
    title: str
    status: int
    detail: str
    code: str = Field(examples=["invalid_value"])
    field: str | None = Field(default=None, examples=["window.lower_mm"])
    value: str | None = Field(default=None, examples=["-400.0"])
    bound: str | None = Field(default=None, examples=["at least -100"])
    errors: list[BrokenBound] | None = Field(
        default=None, description="All values outside their bounds, starting with the one above; at most 20"
    )
