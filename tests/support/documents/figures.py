"""The accuracy table in docs/5-evidence/evaluation.md: ``python -m tests.support.documents.figures REPORT`` writes it.

``REPORT`` is a folder that ``tidegate evaluate --accuracy`` has written at this commit; ``make docs-figures`` runs
both. The part names the commit and a fingerprint of the code that the figures depend on: `stale` compares it, and a
release with figures of other code is refused.
"""

import csv
import re
import subprocess
import sys
from pathlib import Path

from engine.lab.evaluation.runs.datasets import fingerprint
from engine.lab.evaluation.runs.trial import MEASURING_SOURCES
from tests.support.generated_sections import part_of, write_parts
from tests.support.repository import ROOT

DOCUMENT = Path("docs") / "5-evidence" / "evaluation.md"
PART = "accuracy"
CODE = re.compile(r"code `([0-9a-f]{16})`")


class UncommittedError(RuntimeError):
    """The figures would be of no commit."""


def code_of_figures() -> str:
    """Return the fingerprint of what the figures depend on: the phantom, the measurement and its scores."""
    return fingerprint("lab/phantom/*.py", "lab/evaluation/runs/*.py", *MEASURING_SOURCES)


def stale(root: Path = ROOT) -> str | None:
    """Return why the figures are not those of this code; None where they are."""
    found = CODE.search(part_of((root / DOCUMENT).read_text(encoding="utf-8"), PART))
    if found is None:
        return f"{DOCUMENT}: the accuracy figures name no code; run make docs-figures"
    if found[1] != code_of_figures():
        return f"{DOCUMENT}: the accuracy figures are of other code ({found[1]}); run make docs-figures"
    return None


def accuracy(report: Path, commit: str) -> str:
    """Return the part: the table that the command printed, in Markdown."""
    rows = list(csv.reader((report / "accuracy.csv").read_text(encoding="utf-8").splitlines()))
    head, body = rows[0], rows[1:]
    table = (head, ["---"] * len(head), *([_short(cell) for cell in row] for row in body))
    lines = [f"| {' | '.join(row)} |" for row in table]
    said = (
        f"`tidegate evaluate --accuracy` printed at commit {commit}, code `{code_of_figures()}` (mm, cells of 10 px):"
    )
    return "\n".join([said, "", *lines])


def _short(cell: str) -> str:
    """Return a number with three digits, and any other cell as it is."""
    try:
        return f"{float(cell):.3f}"
    except ValueError:
        return cell


def main() -> None:
    """Write the part."""
    if len(sys.argv) != 2:
        sys.exit("usage: python -m tests.support.documents.figures REPORT")

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()

    if git("status", "--porcelain", "--", "engine"):
        msg = "engine/ has changes that are not committed: the figures would be of no commit"
        raise UncommittedError(msg)
    write_parts(ROOT / DOCUMENT, {PART: lambda: accuracy(Path(sys.argv[1]), git("rev-parse", "--short=8", "HEAD"))})


if __name__ == "__main__":
    main()
