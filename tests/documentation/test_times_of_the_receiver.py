"""Safety, hazards, beam and faults give one time for a process that stands still: the receiver's, not the lease's."""

import re

import pytest

from engine.beam.heartbeat_drill import RECEIVER_DROP_MS
from tests.support.beam.modbus_server import DROP_NS
from tests.support.documents.hazards import sections
from tests.support.repository import ROOT
from verification.faults.kinds import RECEIVER_MS

SAFETY = (ROOT / "docs" / "2-clinical" / "safety.md").read_text(encoding="utf-8")
HAZARDS = (ROOT / "docs" / "2-clinical" / "hazards.md").read_text(encoding="utf-8")
BEAM = (ROOT / "docs" / "3-operate" / "beam.md").read_text(encoding="utf-8")
FAULTS = (ROOT / "docs" / "5-evidence" / "faults.md").read_text(encoding="utf-8")
WITHIN = f"{RECEIVER_DROP_MS:.0f} ms"


def _text(number):
    return " ".join(next(one.text for one in sections(SAFETY + HAZARDS) if one.number == number).split())


@pytest.mark.parametrize("name", ["2", "H1", "H2", "H10", "B6"])
def test_each_section_about_a_process_that_stands_still_gives_the_receiver_s_time(name):
    assert re.search(rf"(receiver|contact).*{WITHIN}", _text(name))


def test_no_rule_states_that_the_lease_of_a_killed_process_ends_in_the_line():
    assert not re.search(r"expires? in the line|lease in the line", SAFETY + HAZARDS)
    assert "kept in the engine's process" in _text("2")


def test_what_is_written_is_what_the_drill_asks_the_test_receiver_does_and_the_campaign_allows():
    assert DROP_NS == RECEIVER_DROP_MS * 1_000_000
    assert f"| {WITHIN} + {RECEIVER_MS - RECEIVER_DROP_MS:.0f} ms | the engine's process is killed" in FAULTS
    assert f"**Drop the permit when the heartbeat has stood still for {WITHIN}**" in BEAM


@pytest.mark.parametrize("kind", ["engine-killed", "frozen"])
def test_what_was_measured_is_within_the_time_that_is_written(kind):
    cells = [cell.strip() for cell in next(line for line in FAULTS.splitlines() if f"| {kind} |" in line).split("|")]
    slowest_ms, bound_ms = float(cells[5]), float(cells[6])
    assert bound_ms == RECEIVER_MS
    assert slowest_ms <= bound_ms
