"""Strict reading of untrusted JSON: bounded in size and depth, every number in its bounds, no key unknown or twice.

Each refusal names the field (a dotted path, ``file`` for the document itself), the value and the bound. The reader
chooses the class of the error: a calibration uses :class:`engine.core.errors.CalibrationError`.
"""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from engine.core.bounds import check_number, check_whole_number
from engine.core.errors import InvalidValueError
from engine.core.files import open_plain

ROOT = "file"
"""Field name of the document itself."""

_ESCAPED_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")
"""Unpaired surrogates: such text cannot be encoded, not even in a refusal."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StrictJson:
    """Limits of one kind of document; ``error`` is raised for every violation."""

    error: type[InvalidValueError] = InvalidValueError
    max_bytes: int = 64 * 1024
    max_nesting: int = 8

    def load(self, path: Path) -> object:
        """Read and parse a file."""
        return self.parse(self.read_bytes(path))

    def read_bytes(self, path: Path) -> bytes:
        """Read a file, one byte more than is allowed at most, so that :meth:`parse` can refuse it."""
        try:
            with open_plain(path) as file:
                return file.read(self.max_bytes + 1)
        except (OSError, ValueError) as error:  # a name with a NUL is a ValueError
            raise self.error(ROOT, path.name, f"readable ({getattr(error, 'strerror', None) or error})") from error

    def parse(self, text: bytes) -> object:
        """Parse a document; no key twice, no NaN, no infinity, no half characters, not deep."""
        if len(text) > self.max_bytes:
            raise self.error(ROOT, f"{len(text)} bytes or more", f"at most {self.max_bytes} bytes")
        self._refuse_deep_nesting(text)
        try:
            document: object = json.loads(
                text,
                object_pairs_hook=self._unique_keys,
                parse_constant=self._refuse_constant,
                parse_float=self._finite,
            )
            if _ESCAPED_SURROGATE.search(text):
                json.dumps(document, ensure_ascii=False).encode()
        except ValueError as error:  # no JSON, no UTF-8, a number of thousands of digits, or half a character
            reason = str(error).splitlines()[0][:80]
            raise self.error(ROOT, f"{len(text)} bytes", f"a JSON document ({reason})") from error
        return document

    def fields(
        self, field: str, value: object, *, required: tuple[str, ...], optional: tuple[str, ...] = ()
    ) -> Mapping[str, object]:
        """Take an object that has all required keys and no unknown one."""
        if not isinstance(value, dict):
            raise self.error(field, value, "a JSON object")
        for key in value:
            if key not in required and key not in optional:
                raise self.error(child(field, key)[:80], "unknown", f"one of {', '.join(required + optional)}")
        for key in required:
            if key not in value:
                raise self.error(child(field, key), "missing", "given")
        return value

    def items(self, field: str, value: object, low: int, high: int) -> list[object]:
        """Take a list of ``low`` to ``high`` items."""
        if not isinstance(value, list) or not low <= len(value) <= high:
            raise self.error(field, value, f"a list of {low} to {high} items")
        return value

    def name(self, field: str, value: object) -> str:
        """Take a short printable text."""
        if not isinstance(value, str) or not 1 <= len(value) <= 80 or not value.isprintable():
            raise self.error(field, value, "1 to 80 printable characters")
        return value

    def integer(self, field: str, value: object, low: int, high: int) -> int:
        """Take a whole number in its bound."""
        return check_whole_number(field, value, low, high, error=self.error)

    def number(self, field: str, value: object, low: float, high: float) -> float:
        """Take a number in its bound."""
        return check_number(field, value, low, high, error=self.error)

    def vector(self, field: str, value: object, length: int, low: float, high: float) -> list[float]:
        """Take ``length`` numbers, each in its bound."""
        if not isinstance(value, list) or len(value) != length:
            raise self.error(field, value, f"{length} numbers")
        return [self.number(f"{field}[{i}]", item, low, high) for i, item in enumerate(value)]

    def _refuse_deep_nesting(self, text: bytes) -> None:
        depth = 0
        for byte in text:
            depth += (byte in b"[{") - (byte in b"]}")
            if depth > self.max_nesting:
                raise self.error(
                    ROOT, f"nested deeper than {self.max_nesting}", f"nested at most {self.max_nesting} deep"
                )

    def _unique_keys(self, pairs: list[tuple[str, object]]) -> dict[str, object]:
        keys: dict[str, object] = {}
        for key, value in pairs:
            if key in keys:
                raise self.error(key[:80], "given twice", "given once")
            keys[key] = value
        return keys

    def _finite(self, text: str) -> float:
        number = float(text)
        if not math.isfinite(number):
            raise self.error(ROOT, text[:80], "made of finite numbers")
        return number

    def _refuse_constant(self, name: str) -> float:
        raise self.error(ROOT, name, "made of finite numbers")


def child(field: str, key: str) -> str:
    """Name a key of a field; the document's own keys have no prefix."""
    return key if field == ROOT else f"{field}.{key}"
