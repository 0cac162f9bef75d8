"""Parts of the documents that a command writes: each stands between two markers, and a test compares it.

``<!-- made: NAME -->`` and ``<!-- end: NAME -->``, each on a line of its own: what is between is the command's.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]


class PartMissingError(ValueError):
    """A document has no such part, or has it twice."""


def part_of(text: str, name: str) -> str:
    """What the document holds between the markers of ``name``."""
    begin, end = _markers(name)
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        msg = f"{begin!r} and {end!r} must stand once each, in this order"
        raise PartMissingError(msg)
    return text[text.index(begin) + len(begin) : text.index(end)].strip("\n")


def with_part(text: str, name: str, made: str) -> str:
    """The document with that part anew."""
    part_of(text, name)
    begin, end = _markers(name)
    return f"{text[: text.index(begin)]}{begin}\n{made}\n\n{text[text.index(end) :]}"


def write_parts(document: Path, makers: Mapping[str, Callable[[], str]]) -> bool:
    """Write every part anew; return whether anything changed."""
    before = text = document.read_text(encoding="utf-8")
    for name, make in makers.items():
        text = with_part(text, name, make())
    if text != before:
        document.write_text(text, encoding="utf-8")
    return text != before


def _markers(name: str) -> tuple[str, str]:
    return f"<!-- made: {name} -->\n", f"<!-- end: {name} -->\n"
