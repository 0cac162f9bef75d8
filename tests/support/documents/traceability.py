"""The matrix of docs/2-clinical/traceability.md: every rule and hazard with its risk, requirements, and tests.

Rules, hazards and tests are read from docs/2-clinical/safety.md; the ratings are here, in the order of that page.
``python -m tests.support.documents.traceability`` prints the matrix, ``--write`` writes it.
``python -m tests.support.documents.traceability --ran FILE...`` ends with 1 where a named test is in none of the files
that ``pytest --junitxml`` wrote: `make test` runs it at its end.
"""

import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from tests.support.generated_sections import print_or_write
from tests.support.repository import ROOT

SAFETY = ROOT / "docs" / "2-clinical" / "safety.md"
DOCUMENT = ROOT / "docs" / "2-clinical" / "traceability.md"
SEVERITIES = {4: "critical", 3: "serious", 2: "minor"}
PROBABILITIES = {5: "frequent", 4: "probable", 3: "occasional", 2: "remote", 1: "improbable"}


class Rating(NamedTuple):
    """Severity of a hazard, its probability without and with the mitigation, and the rules that it puts to the test."""

    severity: int
    without: int
    with_it: int
    rules: str


RATINGS: dict[str, Rating] = {
    "S1": Rating(3, 3, 1, "1 2"),
    "S2": Rating(3, 4, 2, "1 2"),
    "S3": Rating(3, 4, 2, "1"),
    "S4": Rating(3, 4, 2, "1"),
    "S5": Rating(4, 3, 2, "1"),
    "S6": Rating(4, 2, 1, "1"),
    "S7": Rating(3, 3, 2, "1"),
    "S8": Rating(3, 3, 1, "1 2"),
    "S9": Rating(3, 3, 1, "1 4"),
    "S10": Rating(3, 2, 1, "1 2"),
    "S11": Rating(3, 4, 2, "1 2"),
    "S12": Rating(2, 3, 1, "1"),
    "S13": Rating(3, 3, 2, "1 2"),
    "S14": Rating(3, 2, 1, "1 2"),
    "S15": Rating(3, 3, 2, "1 2"),
    "S16": Rating(3, 4, 2, "1 2"),
    "P1": Rating(3, 4, 2, "1 2"),
    "P2": Rating(3, 5, 2, "1 2"),
    "P3": Rating(3, 4, 2, "1 2"),
    "P4": Rating(3, 3, 2, "1 6"),
    "P5": Rating(4, 3, 2, "1"),
    "P6": Rating(3, 3, 1, "1 3"),
    "P7": Rating(4, 3, 2, "1"),
    "P8": Rating(3, 4, 2, "1 6"),
    "P9": Rating(3, 4, 2, "1 2"),
    "P10": Rating(3, 3, 1, "1 6"),
    "P11": Rating(4, 3, 2, "1 6"),
    "B1": Rating(3, 2, 1, "1"),
    "B2": Rating(3, 2, 1, "1 4"),
    "B3": Rating(4, 2, 1, "2 4"),
    "B4": Rating(4, 3, 1, "2 5"),
    "B5": Rating(3, 2, 1, "1 2"),
    "B6": Rating(4, 3, 2, "2 5"),
    "B7": Rating(4, 2, 2, "2 4"),
    "H1": Rating(3, 3, 2, "2"),
    "H2": Rating(3, 2, 1, "2 5"),
    "H3": Rating(4, 1, 1, "2"),
    "H4": Rating(3, 1, 1, "1 2"),
    "H5": Rating(3, 2, 1, "2 5"),
    "H6": Rating(2, 3, 1, "7 8"),
    "H7": Rating(2, 3, 1, "7 8"),
    "H8": Rating(2, 3, 1, "7"),
    "H9": Rating(3, 3, 1, "2 5"),
    "H10": Rating(3, 2, 1, "2 5"),
    "H11": Rating(3, 2, 1, "3"),
    "U1": Rating(3, 4, 2, "1"),
    "U2": Rating(4, 3, 3, "6"),
    "U3": Rating(4, 3, 1, "1"),
    "U4": Rating(3, 3, 1, "6"),
    "U5": Rating(3, 3, 1, "6"),
    "U6": Rating(4, 2, 1, "3"),
    "U7": Rating(4, 2, 1, "3"),
    "U8": Rating(3, 3, 1, "3"),
    "U9": Rating(3, 3, 1, "3 4"),
    "U10": Rating(3, 2, 1, "3"),
    "U11": Rating(3, 3, 1, "8"),
    "U12": Rating(3, 4, 1, "3 4"),
    "U13": Rating(4, 3, 2, "3"),
    "U14": Rating(3, 3, 2, "4"),
    "U15": Rating(2, 3, 1, "1 2"),
    "U16": Rating(3, 2, 1, "3"),
    "U17": Rating(3, 3, 1, "6 7"),
    "U18": Rating(3, 3, 1, "2"),
    "U19": Rating(3, 2, 1, "1"),
    "U20": Rating(3, 3, 1, "1"),
    "U21": Rating(3, 2, 1, "1"),
}


class Traced(NamedTuple):
    """A row of safety.md: its number, what it says first, and the tests that it names."""

    number: str
    text: str
    tests: tuple[str, ...]


def traced(page: str) -> list[Traced]:
    """Return the rules ("1" to "8") and the hazards ("S1", ...) of the page, in its order."""
    found = []
    for line in page.splitlines():
        row = re.match(r"\| (?:\*\*(\d)\*\*|([A-Z]\d+)) \| (.*?) \|", line)
        if row is not None:
            number, text = row[1] or row[2], row[3]
            found.append(
                Traced(number, text, tuple(dict.fromkeys(re.findall(r"tests/[\w/]+\.py(?:::test_\w+)?", line))))
            )
    return found


def matrix() -> str:
    """One row a hazard: risk without and with the mitigation, the rules it tests, its own tests."""
    lines = ["| | hazard | severity | probability: without, with the mitigation | rules | tests |", "|---" * 6 + "|"]
    for row in traced(SAFETY.read_text(encoding="utf-8")):
        if not row.number.isdigit():
            rating = RATINGS[row.number]
            rules = ", ".join(f"R{rule}" for rule in rating.rules.split())
            probabilities = f"{PROBABILITIES[rating.without]}, {PROBABILITIES[rating.with_it]}"
            lines.append(
                f"| {row.number} | {row.text} | {SEVERITIES[rating.severity]} | {probabilities} | {rules} | "
                f"{_names(row.tests)} |"
            )
    return "\n".join(lines)


def requirements() -> str:
    """One row a rule: its text, the hazards that test it, its own tests."""
    lines = ["| | requirement | hazards | tests |", "|---" * 4 + "|"]
    for row in traced(SAFETY.read_text(encoding="utf-8")):
        if row.number.isdigit():
            hazards = ", ".join(number for number, rating in RATINGS.items() if row.number in rating.rules.split())
            lines.append(f"| R{row.number} | {row.text} | {hazards} | {_names(row.tests)} |")
    return "\n".join(lines)


def _names(tests: Sequence[str]) -> str:
    return "<br>".join(f"`{test}`" for test in tests) or "none: a residual risk of safety.md"


def ran_in(file: Path) -> Iterator[str]:
    """Yield the tests in a file of ``pytest --junitxml`` that were not skipped, as pytest names them."""
    for case in ElementTree.parse(file).iter("testcase"):
        if case.find("skipped") is None:
            module = case.get("classname", "").split(".")
            yield f"{'/'.join(module)}.py::{case.get('name')}"


def not_run(named: Iterable[str], ran: Iterable[str]) -> list[str]:
    """Return the named tests and test files of which no case ran."""
    cases = {case.partition("[")[0] for case in ran}
    known = cases | {case.partition("::")[0] for case in cases}
    return [test for test in named if test not in known]


MADE = {"requirements": requirements, "hazards": matrix}
"""Every part of the document that the code makes, by its name there."""
main = partial(print_or_write, DOCUMENT, MADE)


def check(files: Sequence[Path]) -> int:
    """Print the tests that safety.md names and that did not run; return the exit code."""
    named = [test for row in traced(SAFETY.read_text(encoding="utf-8")) for test in row.tests]
    missing = not_run(dict.fromkeys(named), [case for file in files if file.exists() for case in ran_in(file)])
    sys.stdout.write("".join(f"safety.md names {test}, which did not run\n" for test in missing))
    return 1 if missing else 0


if __name__ == "__main__":
    if sys.argv[1:2] == ["--ran"]:
        sys.exit(check([Path(word) for word in sys.argv[2:]]))
    main()
