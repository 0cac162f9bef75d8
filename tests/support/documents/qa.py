"""The table of checks in docs/2-clinical/qa.md, made from the code: ``python -m tests.support.documents.qa`` prints it.

With ``--write`` it puts it into the document instead.
"""

from functools import partial

from engine.qa.checks import CHECKS
from engine.qa.results import QaCheck, Sidedness
from tests.support.generated_sections import print_or_write
from tests.support.repository import ROOT

DOCUMENT = ROOT / "docs" / "2-clinical" / "qa.md"


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
main = partial(print_or_write, DOCUMENT, MADE)


if __name__ == "__main__":
    main()
