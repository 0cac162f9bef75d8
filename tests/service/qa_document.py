"""The table of checks in docs/qa.md, made from the code: ``python -m tests.service.qa_document`` prints it.

With ``--write`` it puts it into the document instead.
"""

import sys

from engine.qa.checks import CHECKS
from engine.qa.results import QaCheck, Sidedness
from tests.made_parts import ROOT, write_parts

DOCUMENT = ROOT / "docs" / "qa.md"


def check_table() -> str:
    """One row a check: in which runs, how it is measured, the bounds and where they come from."""
    head = ["| check | in | measured | warns | fails | widest | from |", "|---|---|---|---|---|---|---|"]
    return "\n".join(head + [_row(check) for check in CHECKS])


def _row(check: QaCheck) -> str:
    sign = "\N{PLUS-MINUS SIGN}" if check.sidedness is Sidedness.ABSOLUTE else ""
    unit = f" {check.unit}" if check.unit else ""
    bounds = [f"{sign}{value:g}{unit}" for value in (check.warn, check.fail, check.most)]
    return (
        f"| {check.title}, `{check.code}` | {check.kinds[0]} | {check.method} | {' | '.join(bounds)} | {check.source} |"
    )


MADE = {"checks": check_table}
"""Every part of the document that the code makes, by its name there."""


def main(arguments: list[str]) -> None:
    """Print the table, or write it."""
    if arguments == ["--write"]:
        changed = write_parts(DOCUMENT, MADE)
        sys.stdout.write(f"{DOCUMENT.name} {'is written anew' if changed else 'says so already'}\n")
        return
    if arguments:
        sys.exit("usage: python -m tests.service.qa_document [--write]")
    sys.stdout.write(f"{check_table()}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
