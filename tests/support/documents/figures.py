"""Figures in docs/5-evidence/evaluation.md: ``python -m tests.support.documents.figures REPORT`` writes them.

``REPORT`` is a folder that ``tidegate evaluate --accuracy``, ``tidegate evaluate budget`` and ``tidegate evaluate
integrity --slow --in-turn`` have written at this commit; ``make docs-figures`` runs all of them. Each part names the
commit and a fingerprint of the code that its figures depend on: `stale` compares it, and a release with figures of
other code is refused.
"""

import csv
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from engine.offline.result_files import fingerprint
from lab.evaluation.runs.trial import MEASURING_SOURCES
from lab.phantom.sensor import BENCHED
from tests.support.generated_sections import part_of, write_parts
from tests.support.repository import ROOT

DOCUMENT = Path("docs") / "5-evidence" / "evaluation.md"
HAZARDS = Path("docs") / "2-clinical" / "hazards.md"
CODE = re.compile(r"code `([0-9a-f]{16})`")
SOURCES = {
    "accuracy": ("lab/phantom/*.py", "lab/evaluation/runs/*.py", *MEASURING_SOURCES),
    "budget": ("lab/phantom/*.py", "lab/evaluation/runs/*.py", *MEASURING_SOURCES),
    "integrity": ("lab/phantom/*.py", "lab/evaluation/integrity/*.py", *MEASURING_SOURCES),
}
"""What each part depends on: the phantom, the measurement and its judgement; globs of `fingerprint`."""


class UncommittedError(RuntimeError):
    """The figures would be of no commit."""


def code_of(part: str) -> str:
    """Return the fingerprint of what a part's figures depend on."""
    return fingerprint(*SOURCES[part])


def stale(root: Path = ROOT) -> str | None:
    """Return why figures are not those of this code; None where they are."""
    text = (root / DOCUMENT).read_text(encoding="utf-8")
    for part in SOURCES:
        found = CODE.search(part_of(text, part))
        if found is None:
            return f"{DOCUMENT}: the figures of {part} name no code; run make docs-figures"
        if found[1] != code_of(part):
            return f"{DOCUMENT}: the figures of {part} are of other code ({found[1]}); run make docs-figures"
    return None


def accuracy(report: Path, commit: str) -> str:
    """Return the part: the table that the command printed, in Markdown."""
    head, *body = _rows(report / "accuracy.csv")
    said = (
        f"`tidegate evaluate --accuracy` printed at commit {commit}, code `{code_of('accuracy')}` (mm, cells of 10 px):"
    )
    return "\n".join([said, "", *_table(head, [[_short(cell, 3) for cell in row] for row in body])])


def budget(report: Path, commit: str) -> str:
    """Return the part: the share of each cause of error, as the command printed it."""
    head, *body = _rows(report / "budget.csv")
    said = f"`tidegate evaluate budget` printed at commit {commit}, code `{code_of('budget')}` (mm, cells of 10 px):"
    return "\n".join([said, "", *_table(head, [[_short(cell, 3) for cell in row] for row in body])])


class _Case(NamedTuple):
    """What the command printed of a falsification on one sensor."""

    hazard: str
    measured: str
    longest_s: str
    largest_mm: str
    named_s: str
    on_outside_s: float
    misses: str

    @classmethod
    def of(cls, row: dict[str, str]) -> "_Case":
        """Read a row of the command's CSV."""
        return cls(
            row["hazard"],
            _short(row["measured [%]"], 0),
            _short(row["longest [s]"], 2),
            _short(row["largest error [mm]"], 1),
            _short(row["named after [s]"], 2) or "not by all",
            float(row["of it outside [s]"]),
            row["misses"],
        )

    @property
    def cells(self) -> list[str]:
        """Its cells of the document's table."""
        return [f"{self.measured}; {self.longest_s}; {self.largest_mm}; {self.named_s}", self.misses or "none"]


def integrity(report: Path, commit: str) -> str:
    """Return the part: how many falsifications meet the targets, and those that do not."""
    found = {sensor: _cases(report / f"integrity_{sensor}.csv") for sensor in BENCHED}
    names = list(found[next(iter(BENCHED))])
    missed = [name for name in names if any(found[sensor][name].misses for sensor in BENCHED)]
    outside_s = max(case.on_outside_s for cases in found.values() for case in cases.values())
    said = (
        f"`tidegate evaluate integrity --slow --in-turn` printed at commit {commit}, code `{code_of('integrity')}`: "
        f"of {len(names)} falsifications and honest recordings {len(names) - len(missed)} meet every target on both "
        "sensors. The beam was on with the true motion more than 1 mm outside of the window for at most "
        f"{outside_s:.2f} s. The others: frames measured [%]; longest time with an error above 1 mm [s]; largest "
        "error [mm]; named after [s]."
    )
    head = ["falsification", *(part for sensor in BENCHED for part in (sensor, "misses"))]
    rows = [[", ".join(name), *(cell for sensor in BENCHED for cell in found[sensor][name].cells)] for name in missed]
    return "\n".join([said, "", *_table(head, rows)])


def hazards(report: Path, commit: str) -> str:
    """Return the part: for each hazard that has falsifications, how many meet the targets on each sensor."""
    found = {sensor: list(_cases(report / f"integrity_{sensor}.csv").values()) for sensor in BENCHED}
    names = sorted({case.hazard for cases in found.values() for case in cases if case.hazard})
    said = (
        f"`tidegate evaluate integrity --slow --in-turn` printed at commit {commit}, code `{code_of('integrity')}`: "
        "of the falsifications of each hazard those that meet every target; longest time with an error above 1 mm as "
        "measured [s]; beam on with the true motion more than 1 mm outside of the window [s]."
    )
    rows = []
    for name in names:
        cells = [name]
        for cases in found.values():
            of = [case for case in cases if case.hazard == name]
            longest_s, outside_s = max(float(case.longest_s) for case in of), max(case.on_outside_s for case in of)
            cells.append(f"{sum(not case.misses for case in of)} of {len(of)}; {longest_s:.2f}; {outside_s:.2f}")
        rows.append(cells)
    return "\n".join([said, "", *_table(["hazard", *BENCHED], rows)])


def _cases(path: Path) -> dict[tuple[str, str], _Case]:
    head, *body = _rows(path)
    rows = [dict(zip(head, row, strict=True)) for row in body]
    return {(row["kind"], row["size"] or "-"): _Case.of(row) for row in rows}


def _rows(path: Path) -> list[list[str]]:
    return list(csv.reader(path.read_text(encoding="utf-8").splitlines()))


def _table(head: list[str], body: list[list[str]]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *body)]


def _short(cell: str, digits: int) -> str:
    """Return a number with some digits, and any other cell as it is."""
    try:
        return f"{float(cell):.{digits}f}"
    except ValueError:
        return cell


def main() -> None:
    """Write the parts."""
    if len(sys.argv) != 2:
        sys.exit("usage: python -m tests.support.documents.figures REPORT")

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()

    if git("status", "--porcelain", "--", "engine"):
        msg = "engine/ has changes that are not committed: the figures would be of no commit"
        raise UncommittedError(msg)
    report, commit = Path(sys.argv[1]), git("rev-parse", "--short=8", "HEAD")
    write_parts(
        ROOT / DOCUMENT,
        {
            "accuracy": lambda: accuracy(report, commit),
            "budget": lambda: budget(report, commit),
            "integrity": lambda: integrity(report, commit),
        },
    )
    write_parts(ROOT / HAZARDS, {"falsified": lambda: hazards(report, commit)})


if __name__ == "__main__":
    main()
