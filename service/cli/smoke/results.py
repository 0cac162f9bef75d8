"""What a check found, and the table and document of all of them."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

SCHEMA = "tidegate.smoke/1"
COLORS = {"ok": "green", "warning": "yellow", "failed": "red", "skipped": "dim"}


class Outcome(StrEnum):
    """Result of a check."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckResult:
    """One check; ``figures`` are the measured values, by name and unit."""

    check: str
    outcome: Outcome
    detail: str
    figures: dict[str, object] = field(default_factory=dict)


def is_passed(results: Sequence[CheckResult], *, is_strict: bool) -> bool:
    """Whether no check failed; strictly, none has a warning either."""
    bad = {Outcome.FAILED, Outcome.WARNING} if is_strict else {Outcome.FAILED}
    return bool(results) and not any(one.outcome in bad for one in results)


def as_json(url: str, results: Sequence[CheckResult], *, is_strict: bool) -> str:
    """Return the results as a JSON document."""
    document = {
        "schema": SCHEMA,
        "url": url,
        "passed": is_passed(results, is_strict=is_strict),
        "checks": [asdict(one) for one in results],
    }
    return json.dumps(document, indent=1)


def as_table(url: str, results: Sequence[CheckResult]) -> "Table":
    """Return the results as a table for the terminal."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=escape(url), title_justify="left")
    for heading in ("check", "result", "detail"):
        table.add_column(heading)
    for one in results:
        color = COLORS[one.outcome]
        table.add_row(one.check, f"[{color}]{one.outcome}[/{color}]", escape(one.detail))
    return table
