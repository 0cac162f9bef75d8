"""How old the documents' figures are: ``python -m tests.support.documents.ages`` names those behind the code.

Figures name the commit at which a command printed them. Where the code that they depend on is known by its fingerprint
(docs/5-evidence/evaluation.md), that decides; of all others the number of commits since is told.
"""

import functools
import re
import subprocess
import sys
from collections.abc import Iterator

from tests.support.documents.figures import stale
from tests.support.repository import ROOT

COMMIT = re.compile(r"\b((?:[Aa]t|of|commits?)(?: commit)?) `?(?=[0-9a-f]*[0-9])([0-9a-f]{7,12})\b`?")
OLD = 200
"""Commits after which figures are named."""


@functools.cache
def commits_since(commit: str) -> int | None:
    """Return how many commits came after one; None without the history, or where it is not in it."""
    command = ["git", "rev-list", "--count", f"{commit}..HEAD", "--"]
    try:
        done = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True)
    except OSError:
        return None
    return int(done.stdout) if done.returncode == 0 else None


def with_ages(text: str) -> str:
    """Return a page's text with the age of each commit that figures name, where they are old."""

    def said(found: re.Match[str]) -> str:
        since = commits_since(found[2])
        return found[0] if since is None or since < OLD else f"{found[0]} (**{since} commits ago**)"

    return COMMIT.sub(said, text)


def old() -> Iterator[str]:
    """Yield a line for each page with figures that are older than the code, or old."""
    behind = stale()
    if behind is not None:
        yield behind
    for page in sorted((ROOT / "docs").rglob("*.md")):
        if page.parent.name == "adr":
            continue  # a decision has the figures that it was made on
        found = {commit: commits_since(commit) for _, commit in COMMIT.findall(page.read_text(encoding="utf-8"))}
        ages = [
            f"{commit}, {since} commits ago" for commit, since in found.items() if since is not None and since >= OLD
        ]
        if ages:
            yield f"{page.relative_to(ROOT)}: figures of {'; '.join(ages)}"


if __name__ == "__main__":
    sys.stdout.writelines(f"{line}\n" for line in old())
