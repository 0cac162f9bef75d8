"""Sentences for people that other languages can be made of: English text that keeps its template and values."""

import enum
import re
from collections.abc import Iterable
from functools import lru_cache
from typing import Self

_FIELD = re.compile(r"\{(\w+)[^{}]*\}")


class Sentence(str):
    """An English sentence with what it was made from; wherever a text will do, it is one.

    Anything that makes a new string of it (an f-string, ``+``) makes plain text, which is shown in English.

    Attributes
    ----------
    template
        The sentence with ``{name}`` in place of each value: the key of its translations.
    values
        By name, what is in these places, as text; a value that is itself a sentence is translated too.
    """

    __slots__ = ("template", "values")

    template: str
    values: dict[str, str]

    def __new__(cls, text: str, template: str, values: dict[str, str]) -> Self:
        """Make the text, with what it was made from."""
        made = super().__new__(cls, text)
        made.template, made.values = template, values
        return made

    def __reduce__(self) -> tuple[type[Self], tuple[str, str, dict[str, str]]]:
        """Keep template and values when handed to another process."""
        return type(self), (str(self), self.template, self.values)


def say(template: str, /, **values: object) -> Sentence:
    """Return the sentence of a template with fields such as ``{shift_mm:.1f}``.

    The template is a literal, so that all of them can be collected for translation. The value of a StrEnum is a word
    that can be translated too.
    """
    shown = {name: _shown(values[name], form) for name, form in _fields(template)}
    bare = _FIELD.sub(r"{\1}", template)
    return Sentence(bare.format_map(shown), bare, shown)


def word(text: str) -> Sentence:
    """Return a word of a fixed set, such as a member of an enumeration, that is translated as such."""
    return Sentence(text, text, {})


def _shown(value: object, form: str) -> str:
    if isinstance(value, enum.StrEnum):
        return word(value.value)
    return value if isinstance(value, Sentence) else f"{value:{form}}"


@lru_cache(maxsize=512)
def _fields(template: str) -> tuple[tuple[str, str], ...]:
    return tuple((found[1], found[0][len(found[1]) + 2 : -1]) for found in _FIELD.finditer(template))


def listed(separator: str, parts: Iterable[str]) -> Sentence:
    """Return the parts that are not empty as one sentence; of a single one, that part."""
    found = list(filter(None, parts))
    if len(found) < 2:
        return word("".join(found)) if not found or not isinstance(found[0], Sentence) else found[0]
    values = {f"part{number}": part for number, part in enumerate(found)}
    return Sentence(separator.join(found), separator.join(f"{{{name}}}" for name in values), values)
