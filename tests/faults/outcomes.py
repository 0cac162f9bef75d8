"""The campaign's memory: one line of JSON a trial, appended as it comes; a campaign goes on where it was stopped."""

import json
from collections.abc import Iterable
from pathlib import Path

from tests.faults.verdict import Outcome

FILE_NAME = "outcomes.jsonl"


class OtherRevisionError(Exception):
    """The folder holds outcomes of another state of the code."""


class OutcomeFile:
    """Outcomes in a folder; a line that a kill cut short is dropped, and its trial done again."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / FILE_NAME

    def read(self) -> list[Outcome]:
        """Return what is there, the newest of each kind and seed."""
        if not self.path.exists():
            return []
        found: dict[tuple[str, int], Outcome] = {}
        for line in self.path.read_text().splitlines():
            try:
                outcome = Outcome.from_json(json.loads(line))
            except (ValueError, KeyError, TypeError):
                continue
            found[outcome.kind, outcome.seed] = outcome
        return list(found.values())

    def append(self, outcome: Outcome) -> None:
        """Add one; behind a cut line a new one is begun."""
        line = json.dumps(outcome.to_json(), separators=(",", ":")) + "\n"
        with self.path.open("a+b") as file:
            if file.tell() > 0:
                file.seek(-1, 2)
                line = line if file.read(1) == b"\n" else "\n" + line
            file.write(line.encode())


def refuse_other_revision(outcomes: Iterable[Outcome], revision: str) -> None:
    """Raise OtherRevisionError unless all outcomes are of this state of the code."""
    others = sorted({outcome.revision for outcome in outcomes} - {revision})
    if others:
        msg = f"the folder holds outcomes of {', '.join(others)}, and this is {revision}: take another, or --keep"
        raise OtherRevisionError(msg)
