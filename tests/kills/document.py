"""Puts the campaign's last table and picture into ``docs/kills.md``, between two marks."""

from collections.abc import Sequence
from pathlib import Path

from tests.kills.table import draw, markdown, summary
from tests.kills.verdict import Outcome

DOCUMENT = Path(__file__).parents[2] / "docs" / "kills.md"
PICTURE = Path("pictures") / "kills.png"
BEGIN, END = "<!-- the table begins -->", "<!-- the table ends -->"


def write_document(outcomes: Sequence[Outcome], *, told: str, document: Path = DOCUMENT) -> None:
    """Replace what lies between the marks, and the picture beside it; ``told`` says where they are from."""
    before, rest = document.read_text().split(BEGIN)
    _, after = rest.split(END)
    picture = document.parent / PICTURE
    picture.parent.mkdir(exist_ok=True)
    draw(outcomes, picture)
    found = summary(outcomes)
    said = (
        f"{told}: {found['kills']} kills, {found['red']} red. {found['within_30_ms_of_an_edge']} came within 30 ms "
        f"behind an edge; {found['kills_with_recovered']} left transitions to recover, {found['recovered']} in all; "
        f"{found['offs_in_the_last_instant']} an off told in the last instant and not kept."
    )
    shown = f"![off, lost and edges]({PICTURE.as_posix()})"
    document.write_text(f"{before}{BEGIN}\n{said}\n\n{markdown(outcomes)}\n{shown}\n{END}{after}")
