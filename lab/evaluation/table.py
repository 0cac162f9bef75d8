"""A table and its output as CSV, JSON and HTML; the command line prints it in the terminal."""

import csv
import html
import math
from dataclasses import dataclass
from io import StringIO

Cell = float | int | str | None
NOTHING = "-"


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Rows of cells under headings.

    Attributes
    ----------
    name
        Name of its file.
    columns
        Headings, with units.
    rows
        Cells; numbers are rounded for display and complete in CSV and JSON; None is "not measured".
    note
        One or two sentences on how to read the table.
    digits
        Decimals to display.
    failed
        Rows that miss their target, shown in red.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""
    digits: int = 2
    failed: frozenset[int] = frozenset()

    def text(self, cell: Cell) -> str:
        """Format one cell."""
        if cell is None or (isinstance(cell, float) and not math.isfinite(cell)):
            return NOTHING
        return f"{cell:.{self.digits}f}" if isinstance(cell, float) else str(cell)

    def to_csv(self) -> str:
        """Return the table as CSV: numbers in full, an empty cell where not measured."""
        out = StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(self.columns)
        for row in self.rows:
            writer.writerow(["" if self.text(cell) == NOTHING else cell for cell in row])
        return out.getvalue()

    def to_html(self) -> str:
        """Return the table as an HTML table; the first column is the row's heading."""
        head = "".join(
            f'<th scope="col"{self._class(number)}>{html.escape(column)}</th>'
            for number, column in enumerate(self.columns)
        )
        body = "".join(self._row(number, row) for number, row in enumerate(self.rows))
        return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"

    def to_json(self) -> dict[str, object]:
        """Return the table as JSON values; NaN and infinity become None."""
        rows = [[None if self.text(cell) == NOTHING else cell for cell in row] for row in self.rows]
        return {"title": self.title, "columns": list(self.columns), "rows": rows, "note": self.note}

    def _class(self, column: int) -> str:
        """HTML class of a column: columns with numbers are right-aligned."""
        has_numbers = column > 0 and any(isinstance(row[column], int | float) for row in self.rows)
        return " class=n" if has_numbers else ""

    def _row(self, number: int, row: tuple[Cell, ...]) -> str:
        first = f'<th scope="row">{html.escape(self.text(row[0]))}</th>'
        others = "".join(
            f"<td{self._class(column)}>{html.escape(self.text(cell))}</td>"
            for column, cell in enumerate(row[1:], start=1)
        )
        return f"<tr{' class=failed' if number in self.failed else ''}>{first}{others}</tr>"
