"""Puts the campaign's last table and picture into ``docs/5-evidence/faults.md``."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from tests.support.generated_sections import write_campaign
from tests.support.repository import ROOT
from verification.faults.plot import draw
from verification.faults.table import Row, markdown

DOCUMENT = ROOT / "docs" / "5-evidence" / "faults.md"


def write_document(table: Sequence[Row], *, reported: str, document: Path = DOCUMENT) -> None:
    """Write both; ``reported`` says where they are from."""
    trials = sum(len(row.outcomes) for row in table)
    unsafe = sum(row.unsafe for row in table)
    write_campaign(
        document,
        said=f"{reported}: {trials} faults of {len(table)} kinds, {unsafe} unsafe.",
        table=markdown(table),
        picture="times from fault to line off",
        draw=partial(draw, table),
    )
