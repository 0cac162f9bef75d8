"""What `tidegate` exports, with its signatures, as the text that a release keeps.

``python -m tests.tidegate.signatures`` writes it; a name or parameter that goes needs its word in CHANGELOG.md.
"""

import inspect
import re
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path

import tidegate

FILE = Path(__file__).with_name("exported.txt")
CHANGELOG = Path(__file__).parents[2] / "CHANGELOG.md"


def exported() -> str:
    """Return one line for each name, and for each public member of Tidegate's own classes."""
    return "".join(f"{line}\n" for name in sorted(tidegate.__all__) for line in _lines(name, getattr(tidegate, name)))


def _lines(name: str, found: object) -> Iterator[str]:
    if not callable(found) or (inspect.isclass(found) and issubclass(found, Exception)):
        yield name
        return
    yield f"{name}{_parameters(found)}"
    if inspect.isclass(found) and found.__module__.startswith("tidegate."):
        for member, held in sorted(vars(found).items()):
            if not member.startswith("_"):
                value = held.__func__ if isinstance(held, (classmethod, staticmethod)) else held
                yield f"{name}.{member}{_parameters(value) if callable(value) else ''}"


def _parameters(found: object) -> str:
    if is_dataclass(found):
        return f"({', '.join(one.name for one in fields(found) if one.init)})"
    given = inspect.signature(found).parameters.values()  # type: ignore[arg-type]
    return f"({', '.join(one.name + ('=' if one.default is not one.empty else '') for one in given)})"


def unnamed_removals(before: str, now: str, changelog: str) -> list[str]:
    """Return the names and parameters that are gone and stand nowhere in the newest part of the changelog."""
    newest = changelog.split("\n## ")[1] if "\n## " in changelog else changelog

    def words(text: str) -> set[tuple[str, str]]:
        lines = [line.partition("(") for line in text.splitlines()]
        return {(name, part) for name, _, rest in lines for part in ("", *re.findall(r"\w+", rest))}

    gone = sorted(words(before) - words(now))
    return [f"{name} {part}".strip() for name, part in gone if f"`{part or name}" not in newest]


if __name__ == "__main__":
    missing = unnamed_removals(FILE.read_text() if FILE.exists() else "", exported(), CHANGELOG.read_text())
    if missing:
        sys.exit(f"removed, and not in CHANGELOG.md: {', '.join(missing)}")
    FILE.write_text(exported())
