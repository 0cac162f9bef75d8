"""What a refusal says: RFC 9457 problems."""

from pydantic import Field

from service.schema_base import Answer


class BrokenBound(Answer):
    """One value of a request that is out of its bound."""

    field: str = Field(examples=["window.lower_mm"])
    value: str = Field(examples=["-400.0"])
    bound: str = Field(examples=["at least -100"])


class Problem(Answer):
    """RFC 9457, with a stable code, and the field, the value and the bound where one was broken."""

    type: str = Field(examples=["urn:tidegate:problem:invalid_value"])
    title: str
    status: int
    detail: str
    code: str = Field(examples=["invalid_value"])
    field: str | None = Field(default=None, examples=["window.lower_mm"])
    value: str | None = Field(default=None, examples=["-400.0"])
    bound: str | None = Field(default=None, examples=["at least -100"])
    errors: list[BrokenBound] | None = Field(
        default=None, description="Every value that is out of its bound, the one above first; at most 20"
    )
