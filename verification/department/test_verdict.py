"""What the campaign calls red, and what it calculates; the campaign itself needs root and minutes."""

from dataclasses import replace

import pytest

from tests.support.generated_sections import part_of
from verification.department.__main__ import DOCUMENT, main, table
from verification.department.costs import Cost, table as cost_table
from verification.department.events import Outcome, RoomMeanwhile
from verification.department.hub import total

WELL = RoomMeanwhile(frames=600, beams=5, other_holds=())
FINE = Outcome(
    event="hub killed",
    seconds=20.0,
    rooms=(WELL, WELL),
    written=30,
    lacked=29,
    caught_up_s=0.3,
    is_lost=False,
    are_intact=True,
)


@pytest.mark.parametrize(
    "affected",
    [
        replace(WELL, beams=0),
        replace(WELL, other_holds=("audit_behind 1",)),
        replace(WELL, other_holds=("frame_late 2", "disk_low 1")),
    ],
)
def test_a_room_without_beam_or_with_a_hold_of_what_is_stored_is_red(affected):
    assert not FINE.is_red
    assert replace(FINE, rooms=(WELL, affected)).is_red
    assert not replace(FINE, rooms=(WELL, replace(WELL, other_holds=("frame_late 2",)))).is_red


def test_a_broken_copy_is_red_and_a_killed_room_is_not_asked():
    assert replace(FINE, are_intact=False).is_red
    assert not replace(FINE, rooms=(WELL, None), lacked=None).is_red
    assert "| killed | 30 | - |" in table([replace(FINE, rooms=(WELL, None), lacked=None)])


def test_sixteen_rooms_are_sixteen_times_one():
    idle = Cost(log_bytes=0.0, network_bytes=0.0, hub_bytes=0.0, hub_processor_s=0.0, metrics_bytes=0.0)
    gating = Cost(log_bytes=1000.0, network_bytes=500.0, hub_bytes=100.0, hub_processor_s=0.002, metrics_bytes=1.0)
    lines = cost_table(idle, gating).splitlines()
    assert lines[2].endswith("| 0.00 | 3.60 | 57.6 |")
    assert lines[6].endswith("| 0.00 | 0.20 | 3.2 |")
    assert lines[7] == "| hub away until 4 GB are reached, hours | | 1193 | |"


def test_rows_are_counted_over_all_tables():
    assert total("audit|50|abc\nqa_runs|2\n\n") == 52


def test_the_campaign_asks_for_root(monkeypatch, capsys):
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    assert main([]) == 2
    assert "need root" in capsys.readouterr().err


def test_the_document_has_both_tables():
    text = DOCUMENT.read_text(encoding="utf-8")
    for event in ("nothing", "hub killed", "network of room 1 cut", "hub's disk full", "room 2 killed"):
        assert f"| {event} |" in part_of(text, "outages")
    assert "sixteen rooms" in part_of(text, "costs")
