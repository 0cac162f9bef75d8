"""Decode the bytes of elements to text, codes, numbers and UIDs; each is bounded, and refused with its tag.

A refusal never contains text, which may be a name. It shows codes, numbers and UIDs.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from service.planning.rt_plan.errors import PlanError
from service.planning.rt_plan.part10 import Item
from service.planning.rt_plan.tags import Tag, named, tag_number

UID = re.compile(r"(0|[1-9][0-9]*)(\.(0|[1-9][0-9]*))*")
CODE = re.compile(r"[A-Z0-9_][A-Z0-9_ ]{0,15}")
INTEGER = re.compile(r"[+-]?[0-9]{1,12}")
DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,4})?")
DATE = re.compile(r"[0-9]{8}")
ESCAPE = b"\x1b"
PIECES = re.compile(rb"[^\x1b]+|\x1b[^\x1b]*")
NO_ESCAPES = frozenset({"iso_ir_58"})
"""Codecs that pydicom gives the escape sequence to, and that keep it as text: GB 2312 has no state in Python."""
NO_ENCODING: tuple[str, ...] = ("ascii",)
SHOWN = 40


@dataclass(frozen=True, slots=True, kw_only=True)
class Elements:
    """Elements of a data set or item; ``place`` is its path in the file, for refusals."""

    values: Item
    place: str = ""
    encodings: tuple[str, ...] = NO_ENCODING

    @property
    def character_terms(self) -> list[str]:
        """Terms of the character set; empty where none is declared."""
        raw = self.values.get(Tag.CHARACTER_SET)
        if not isinstance(raw, bytes) or not raw.strip(b" \0"):
            return []
        return [term.strip(" \0") for term in raw.decode("ascii", "replace").split("\\")]

    def items(self, tag: Tag, *, most: int) -> list["Elements"]:
        """Return a sequence's items, at most ``most``; empty if the element is missing."""
        found = self.values.get(tag, [])
        assert isinstance(found, list), "the reader returns sequences as lists"
        if len(found) > most:
            raise self.refusal(tag, f"{len(found)} items", f"at most {most} items")
        places = (f"{self.place}{tag_number(tag)}[{number}]." for number in range(1, len(found) + 1))
        return [_elements(item, place, self.encodings) for item, place in zip(found, places, strict=True)]

    def text(self, tag: Tag, longest: int) -> str | None:
        """Return a text of one value, stripped; None if it is missing or empty."""
        raw = self._raw(tag)
        try:
            text = decoded(raw, self.encodings).strip(" \0")
        except (UnicodeError, LookupError):
            bound = f"encoded in the {named(Tag.CHARACTER_SET)}"
            raise self.refusal(tag, f"{len(raw)} bytes", bound) from None
        if len(text) > longest:
            raise self.refusal(tag, f"{len(text)} characters", f"at most {longest} characters")
        if not text.isprintable() or "\\" in text:
            raise self.refusal(tag, f"{len(text)} characters", "one value of printable characters")
        return text or None

    def remark(self, tag: Tag, longest: int) -> str | None:
        """Return a multi-line text as one line, cut to ``longest`` characters; None if it cannot be decoded."""
        raw = self._raw(tag)
        try:
            lines = decoded(raw, self.encodings).split()
        except (UnicodeError, LookupError):
            return None
        return "".join(one for one in " ".join(lines) if one.isprintable())[:longest] or None

    def code(self, tag: Tag) -> str | None:
        """Return a code string, or None."""
        return self._matched(tag, CODE, "a code string (CS) of one value")

    def uid(self, tag: Tag) -> str:
        """Return a UID; refuse a missing one."""
        text = self._matched(tag, UID, "a UID (PS3.5, 9)")
        if text is None or len(text) > 64:
            raise self.refusal(
                tag, "missing" if text is None else f"{len(text)} characters", "a UID of 1 to 64 characters"
            )
        return text

    def date(self, tag: Tag) -> str | None:
        """Return a date as YYYYMMDD, or None."""
        return self._matched(tag, DATE, "a date (DA), YYYYMMDD")

    def integer(self, tag: Tag, low: int, high: int) -> int | None:
        """Return a whole number from ``low`` to ``high``, or None."""
        bound = f"a whole number (IS) from {low} to {high}"
        text = self._matched(tag, INTEGER, bound)
        if text is not None and not low <= int(text) <= high:
            raise self.refusal(tag, text, bound)
        return None if text is None else int(text)

    def number(self, tag: Tag, low: int, high: int) -> int:
        """Return a whole number from ``low`` to ``high``; refuse a missing one."""
        found = self.integer(tag, low, high)
        if found is None:
            raise self.refusal(tag, "missing", f"a whole number (IS) from {low} to {high}")
        return found

    def decimal(self, tag: Tag, low: float, high: float) -> float | None:
        """Return a finite number from ``low`` to ``high``, or None."""
        bound = f"a number (DS) from {low:g} to {high:g}"
        text = self._matched(tag, DECIMAL, bound)
        if text is None:
            return None
        value = float(text)
        if not (math.isfinite(value) and low <= value <= high):
            raise self.refusal(tag, text[:SHOWN], bound)
        return value

    def refusal(self, tag: Tag, value: str, bound: str) -> PlanError:
        """Return an error with place, value and bound."""
        place = f"{self.place}{named(tag)}"
        return PlanError(f"{place} is {value}: must be {bound}", field=place, value=value, bound=bound)

    def _raw(self, tag: Tag) -> bytes:
        raw = self.values.get(tag, b"")
        assert isinstance(raw, bytes), "the reader returns values as bytes"
        return raw

    def _matched(self, tag: Tag, pattern: re.Pattern[str], bound: str) -> str | None:
        """Return an ASCII value that matches the pattern; None if it is missing or empty."""
        text = self._raw(tag).strip(b" \0").decode("ascii", "replace")
        if text and not pattern.fullmatch(text):
            raise self.refusal(tag, repr(text[:SHOWN]), bound)
        return text or None


def elements_of(values: Item) -> Elements:
    """Return the elements of a whole data set."""
    return _elements(values, "", NO_ENCODING)


def decoded(raw: bytes, encodings: Sequence[str]) -> str:
    """Decode text with escape sequences (PS3.5, 6.1.2.5); raise UnicodeError or LookupError."""
    return "".join(_piece(piece, encodings) for piece in PIECES.findall(raw))


def _piece(piece: bytes, encodings: Sequence[str]) -> str:
    if not piece.startswith(ESCAPE):
        return piece.decode(encodings[0])
    from pydicom.charset import CODES_TO_ENCODINGS, default_encoding, handled_encodings

    length = 4 if piece.startswith((b"\x1b$(", b"\x1b$)")) else 3
    encoding = CODES_TO_ENCODINGS[piece[:length]]
    if encoding == default_encoding:
        return piece[length:].decode("ascii")
    if encoding not in encodings:
        msg = "escape sequence of a character set that is not declared"
        raise LookupError(msg)
    takes_escape = encoding in handled_encodings and encoding not in NO_ESCAPES
    return (piece if takes_escape else piece[length:]).decode(encoding)


def _elements(values: Item, place: str, around: tuple[str, ...]) -> Elements:
    """Return an item's elements; without its own character set it inherits that of its container (PS3.5, 7.5.3)."""
    outer = Elements(values=values, place=place, encodings=around)
    terms = outer.character_terms
    if not terms:
        return outer
    from pydicom.charset import STAND_ALONE_ENCODINGS, python_encoding

    unknown = [term for term in terms if term not in python_encoding]
    if unknown:
        raise outer.refusal(Tag.CHARACTER_SET, repr(unknown[0][:SHOWN]), "terms of PS3.3, C.12.1.1.2")
    if len(terms) > 1 and set(terms) & set(STAND_ALONE_ENCODINGS):
        raise outer.refusal(Tag.CHARACTER_SET, f"{len(terms)} terms", "one term, if it permits no others")
    return Elements(values=values, place=place, encodings=tuple(_python_name(term) for term in terms))


def _python_name(term: str) -> str:
    """Return Python's codec; the default repertoire is ASCII, not pydicom's Latin-1."""
    from pydicom.charset import default_encoding, python_encoding

    found = python_encoding[term]
    return "ascii" if found == default_encoding else found
