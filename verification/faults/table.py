"""The campaign's table: a row a kind, in colour on the terminal, and as Markdown; and the exit code."""

import statistics
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

from rich.table import Table
from rich.text import Text

from verification.faults.verdict import Expectation, Outcome

HEAD = (
    *("kind", "what", "n", "unsafe", "other", "median ms", "p95", "worst", "bound"),
    *("reason", "recovers", "stood still: worst ms", "missed"),
)
RED = "white on red"
LONG_SEEDS = 40
"""Seeds of a whole campaign, for which the duration is said."""


class Kind(Protocol):
    """What the table needs of a kind of fault."""

    @property
    def code(self) -> str: ...

    @property
    def what(self) -> str: ...

    @property
    def bound(self) -> str: ...

    @property
    def expected(self) -> Expectation: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One kind's figures; ``is_red`` where anything is unsafe, missing or not as promised."""

    kind: Kind
    outcomes: Sequence[Outcome]
    wanted: int

    @property
    def unsafe(self) -> int:
        return sum(outcome.is_unsafe for outcome in self.outcomes)

    @property
    def others(self) -> int:
        return sum(outcome.is_red and not outcome.is_unsafe for outcome in self.outcomes)

    @property
    def missing(self) -> int:
        return max(self.wanted - len(self.outcomes), 0)

    @property
    def is_red(self) -> bool:
        return bool(self.unsafe or self.others or self.missing)

    def cells(self) -> tuple[str, ...]:
        times = sorted(outcome.off_ms for outcome in self.outcomes if outcome.off_ms is not None)
        count = f"{len(self.outcomes)}" + (f" of {self.wanted}" if self.missing else "")
        late = [late_ms for outcome in self.outcomes for late_ms in outcome.disturbed_ms]
        return (
            self.kind.code,
            self.kind.what,
            count,
            str(self.unsafe),
            str(self.others),
            *(_ms(figure) for figure in _figures(times)),
            f"{self.kind.expected.bound_ms:g}",
            _counted(name for outcome in self.outcomes for name in outcome.reported[:1]),
            _counted(outcome.recovery for outcome in self.outcomes if outcome.recovery),
            f"{len(late)}: {max(late):.0f}" if late else "0",
            str(sum(outcome.missed for outcome in self.outcomes)),
        )


def rows(kinds: Iterable[Kind], outcomes: Iterable[Outcome], wanted: int) -> list[Row]:
    """Sort outcomes into a row a kind; ``wanted`` is how many each should have."""
    found = list(outcomes)
    return [
        Row(kind=kind, outcomes=[outcome for outcome in found if outcome.kind == kind.code], wanted=wanted)
        for kind in kinds
    ]


def exit_code(table: Iterable[Row]) -> int:
    """0 where every cell is as promised, else 1."""
    return int(any(row.is_red for row in table))


def terminal_table(table: Iterable[Row]) -> Table:
    """Build the table for a terminal; what is wrong is white on red."""
    made = Table(*HEAD)
    for row in table:
        cells = [Text(cell) for cell in row.cells()]
        for place, is_wrong in ((2, row.missing), (3, row.unsafe), (4, row.others), (7, row.unsafe)):
            if is_wrong:
                cells[place].stylize(RED)
        made.add_row(*cells)
    return made


def markdown(table: Iterable[Row]) -> str:
    """Write the table as Markdown, in short; what is wrong is counted and bold."""
    head = ("kind", "what", "n", "median ms", "worst", "bound", "reason", "recovers")
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in table:
        kind, what, count, unsafe, others, median, _, worst, bound, reason, recovers, *_ = row.cells()
        if row.is_red:
            count = f"**{count}: {unsafe} unsafe, {others} other**"
        cells = (kind, what, count, median, worst, bound, reason, recovers)
        lines.append("| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def troubles(table: Iterable[Row]) -> list[str]:
    """Say what is wrong, a line a trial."""
    return [
        f"{outcome.kind} seed {outcome.seed}: {', '.join(outcome.troubles)}"
        + ("" if outcome.off_ms is None else f" ({outcome.off_ms:.0f} ms)")
        + (f": {outcome.note}" if outcome.note else "")
        for row in table
        for outcome in row.outcomes
        if outcome.is_red
    ]


def _figures(times: Sequence[float]) -> tuple[float | None, float | None, float | None]:
    if not times:
        return None, None, None
    return statistics.median(times), times[min(int(0.95 * len(times)), len(times) - 1)], times[-1]


def _ms(figure: float | None) -> str:
    return "-" if figure is None else f"{figure:.0f}"


def _counted(names: Iterable[str]) -> str:
    found = Counter(names).most_common()
    if len(found) == 1:
        return found[0][0]
    return ", ".join(f"{name} {count}" for name, count in found) or "-"


def bound_text(unsafe: int, trials: int) -> str:
    """Say how many unsafe ones could still be among as many faults as these: the rule of three."""
    return f", 0 of {trials}: below {100.0 * 3.0 / trials:.2g} % at 95 %" if unsafe == 0 and trials > 0 else ""


def duration_text(outcomes: Sequence[Outcome], jobs: int) -> str:
    """Say how long the trials took, and `LONG_SEEDS` seeds would take here."""
    kinds = {outcome.kind for outcome in outcomes}
    if not outcomes:
        return "no trial"
    each_s = sum(outcome.seconds for outcome in outcomes) / len(outcomes)
    hours = each_s * LONG_SEEDS * len(kinds) / jobs / 3600.0
    return f"{each_s:.1f} s a trial: {LONG_SEEDS} seeds of these {len(kinds)} kinds take {hours:.1f} h with {jobs} jobs"
