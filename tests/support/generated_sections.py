"""Parts of the documents that a command writes: each stands between two markers, and a test compares it.

``<!-- made: NAME -->`` and ``<!-- end: NAME -->``, each on a line of its own: what is between is the command's.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

CAMPAIGN = "campaign"


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


def write_campaign(document: Path, *, said: str, table: str, picture: str, draw: Callable[[Path], None]) -> None:
    """Write what a campaign came to, and a picture of the document's name beside it; ``picture`` says what it shows."""
    drawn = Path("pictures") / f"{document.stem}.png"
    (document.parent / drawn).parent.mkdir(exist_ok=True)
    draw(document.parent / drawn)
    write_parts(document, {CAMPAIGN: lambda: f"{said}\n\n{table}\n![{picture}]({drawn.as_posix()})"})


def are_as_made(document: Path, makers: Mapping[str, Callable[[], str]]) -> bool:
    """Whether the document holds what would be written now."""
    text = document.read_text(encoding="utf-8")
    return all(part_of(text, name) == make() for name, make in makers.items())


def print_or_write(
    document: Path, makers: Mapping[str, Callable[[], str]], arguments: Sequence[str] | None = None
) -> None:
    """Print every part, or put them into the document with ``--write``: a document's whole command."""
    asked = list(sys.argv[1:] if arguments is None else arguments)
    if asked == ["--write"]:
        changed = write_parts(document, makers)
        sys.stdout.write(f"{document.name} {'is written anew' if changed else 'says so already'}\n")
    elif asked:
        sys.exit(f"usage: nothing to print the parts of {document.name}, or --write")
    else:
        sys.stdout.write("\n\n".join(make() for make in makers.values()) + "\n")


def _markers(name: str) -> tuple[str, str]:
    return f"<!-- made: {name} -->\n", f"<!-- end: {name} -->\n"
