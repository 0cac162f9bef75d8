"""Puts the campaign's last table and picture into ``docs/faults.md``, between two marks."""

from collections.abc import Sequence
from pathlib import Path

from tests.faults.picture import draw
from tests.faults.table import Row, markdown

DOCUMENT = Path(__file__).parents[2] / "docs" / "faults.md"
PICTURE = Path("pictures") / "faults.png"
BEGIN, END = "<!-- the table begins -->", "<!-- the table ends -->"


def write_document(table: Sequence[Row], *, told: str, document: Path = DOCUMENT) -> None:
    """Replace what lies between the marks, and the picture beside it; ``told`` says where they are from."""
    before, rest = document.read_text().split(BEGIN)
    _, after = rest.split(END)
    picture = document.parent / PICTURE
    picture.parent.mkdir(exist_ok=True)
    draw(table, picture)
    trials = sum(len(row.outcomes) for row in table)
    unsafe = sum(row.unsafe for row in table)
    said = f"{told}: {trials} faults of {len(table)} kinds, {unsafe} unsafe."
    shown = f"![times from fault to line off]({PICTURE.as_posix()})"
    document.write_text(f"{before}{BEGIN}\n{said}\n\n{markdown(table)}\n{shown}\n{END}{after}")
