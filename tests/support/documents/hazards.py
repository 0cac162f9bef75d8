"""The rules of docs/2-clinical/safety.md and the hazards of hazards.md, and whether the tests that they name ran.

``python -m tests.support.documents.hazards STAGE FILE...`` ends with 1 where a named test of that stage is in none of
the files that ``pytest --junitxml`` wrote: `make test` and `make verify` run it at their end.
"""

import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from tests.support.repository import ROOT
from tests.support.selection import stage_of

CLINICAL = ROOT / "docs" / "2-clinical"
SAFETY, HAZARDS = CLINICAL / "safety.md", CLINICAL / "hazards.md"
SEVERITIES = ("minor", "serious", "critical")
PROBABILITIES = ("improbable", "remote", "occasional", "probable", "frequent")
TEST = re.compile(r"`((?:tests|verification)/[\w/]+\.py(?:::test_\w+)?)`")
RATING = re.compile(r"^\*(\w+); (\w+) to (\w+)\. Rules? ([\d, ]+)\.\*$", re.MULTILINE)


class Section(NamedTuple):
    """A rule ("1" to "8") or a hazard ("S1", ...): its number, and what stands below its heading."""

    number: str
    text: str

    @property
    def tests(self) -> tuple[str, ...]:
        """The tests that it names."""
        return tuple(dict.fromkeys(TEST.findall(self.text)))

    @property
    def rating(self) -> tuple[str, str, str, list[str]]:
        """Severity, probability without and with the mitigation, and the rules that the hazard puts to the test."""
        found = RATING.search(self.text)
        assert found is not None, f"{self.number} has no line with its rating"
        return found[1].lower(), found[2], found[3], found[4].split(", ")


def sections(page: str) -> list[Section]:
    """Return the numbered sections of a page, in its order."""
    found = re.split(r"^### ([A-Z]?\d+): ", page, flags=re.MULTILINE)[1:]
    return [
        Section(number, re.split(r"^##? ", text, flags=re.MULTILINE)[0])
        for number, text in zip(found[::2], found[1::2], strict=True)
    ]


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


def named() -> list[str]:
    """Return all tests that the two pages name, once each."""
    return list(dict.fromkeys(TEST.findall("".join(page.read_text(encoding="utf-8") for page in (SAFETY, HAZARDS)))))


def named_in(stage: str) -> list[str]:
    """Return those of them that this stage runs, and those that are not there."""
    files = {test: ROOT / test.partition("::")[0] for test in named()}
    return [test for test, file in files.items() if not file.exists() or stage_of(file) == stage]


def check(stage: str, files: Sequence[Path]) -> int:
    """Print the named tests of a stage that did not run; return the exit code."""
    missing = not_run(named_in(stage), [case for file in files if file.exists() for case in ran_in(file)])
    sys.stdout.write("".join(f"safety.md or hazards.md names {test}, which did not run\n" for test in missing))
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(check(sys.argv[1], [Path(word) for word in sys.argv[2:]]))
