"""Sentences in answers: what they were made from, so that a client can show them in another language.

A sentence without values is its own template and is not listed.
"""

from collections.abc import Iterator
from typing import Annotated

from pydantic import BaseModel, Field, ValidatorFunctionWrapHandler, WrapValidator

from engine.core.sentences import Sentence


class SentenceParts(BaseModel, frozen=True, extra="forbid"):
    """What a sentence was made from."""

    text: str = Field(description="The sentence in English, as in another field of this answer, or in a value")
    template: str = Field(description="The sentence with `{name}` in place of each value; the same in every answer")
    values: dict[str, str] = Field(description="By name, what is in these places; a value may be a sentence itself")


SENTENCES = Field(
    default_factory=list[SentenceParts], description="What the English sentences with values were made from"
)


def _kept(value: object, validate: ValidatorFunctionWrapHandler) -> str:
    return value if isinstance(value, Sentence) else validate(value)


Text = Annotated[str, WrapValidator(_kept)]
"""An English sentence that keeps its template and values until it leaves the service."""


def sentence_parts(*values: object) -> list[SentenceParts]:
    """Return the parts of all sentences in these texts, models and lists, each once."""
    found = {one: one for value in values for one in _sentences(value) if one.values}
    return [SentenceParts(text=str(one), template=one.template, values=one.values) for one in found]


def _sentences(value: object) -> Iterator[Sentence]:
    if isinstance(value, Sentence):
        yield value
        yield from _sentences(list(value.values.values()))
    elif isinstance(value, BaseModel):
        yield from _sentences(list(value.__dict__.values()))
    elif isinstance(value, list):
        for one in value:
            if isinstance(one, Sentence | BaseModel):
                yield from _sentences(one)
