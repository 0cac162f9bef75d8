"""Puts the campaign's last table and picture into ``docs/5-evidence/kills.md``."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from tests.support.generated_sections import write_campaign
from tests.support.repository import ROOT
from verification.kills.table import draw, markdown, summary
from verification.kills.verdict import Outcome

DOCUMENT = ROOT / "docs" / "5-evidence" / "kills.md"


def write_document(outcomes: Sequence[Outcome], *, reported: str, document: Path = DOCUMENT) -> None:
    """Write both; ``reported`` says where they are from."""
    found = summary(outcomes)
    said = (
        f"{reported}: {found['kills']} kills, {found['red']} red. {found['within_30_ms_of_an_edge']} came within 30 ms "
        f"behind an edge; {found['kills_with_recovered']} left transitions to recover, {found['recovered']} in all; "
        f"{found['offs_in_the_last_instant']} an off sent in the last instant and not recorded."
    )
    table, picture = markdown(outcomes), "off, lost and edges"
    write_campaign(document, said=said, table=table, picture=picture, draw=partial(draw, outcomes))
