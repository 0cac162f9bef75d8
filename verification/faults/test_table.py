"""The table, the exit code and the campaign's memory, with planted outcomes."""

import io
import json
import re
from dataclasses import replace

import pytest
from rich.console import Console

from tests.support.generated_sections import CAMPAIGN, part_of
from verification.campaign.outcomes import OtherRevisionError, refuse_other_revision
from verification.campaign.program import left_of
from verification.faults.campaign import FaultCampaign, Trial
from verification.faults.document import DOCUMENT, write_document
from verification.faults.kinds import all_kinds, chosen
from verification.faults.plot import draw
from verification.faults.table import bound_text, duration_text, exit_code, markdown, rows, terminal_table, troubles
from verification.faults.verdict import Outcome, Trouble
from verification.kills.document import DOCUMENT as KILLS

pytestmark = pytest.mark.waiting

KINDS = chosen(["marker-covered", "killed"])
SEEDS = range(1, 4)


def outcome(kind: str, seed: int, *wrong: Trouble, off_ms: float | None = 40.0) -> Outcome:
    return Outcome(
        kind=kind,
        seed=seed,
        off_ms=off_ms,
        troubles=wrong,
        reported=("marker_lost",),
        recovery="by itself",
        revision="r1",
    )


GOOD = [outcome(kind.code, seed, off_ms=30.0 + seed) for kind in KINDS for seed in SEEDS]


def shown(table) -> str:
    console = Console(file=io.StringIO(), force_terminal=True, color_system="standard", width=240)
    console.print(terminal_table(table))
    return console.file.getvalue()


RED = "\x1b[37;41m"


def test_a_campaign_without_a_fault_of_ours_is_green():
    table = rows(KINDS, GOOD, wanted=3)
    assert exit_code(table) == 0
    assert RED not in shown(table)
    assert "**" not in markdown(table)
    assert troubles(table) == []


@pytest.mark.parametrize("trouble", Trouble)
def test_a_single_trouble_makes_a_red_cell_and_exit_code_1(trouble):
    table = rows(KINDS, [*GOOD[1:], outcome("marker-covered", 1, trouble, off_ms=140.0)], wanted=3)
    assert exit_code(table) == 1
    assert RED in shown(table)
    assert re.search(r"\*\*3: (1 unsafe, 0|0 unsafe, 1) other\*\*", markdown(table))
    assert troubles(table) == [f"marker-covered seed 1: {trouble} (140 ms)"]


def test_a_missing_outcome_makes_a_red_cell_and_exit_code_1():
    table = rows(KINDS, GOOD[1:], wanted=3)
    assert exit_code(table) == 1
    assert RED in shown(table)
    assert "**2 of 3: 0 unsafe, 0 other**" in markdown(table)


def test_figures_are_of_the_times_that_were_seen():
    table = rows(KINDS, GOOD, wanted=3)
    line = next(line for line in markdown(table).splitlines() if line.startswith("| killed"))
    assert [cell.strip() for cell in line.split("|")][3:7] == ["3", "32", "33", "100"]


def test_a_picture_is_drawn_with_and_without_times(tmp_path):
    draw(rows(KINDS, GOOD, wanted=3), tmp_path / "times.png")
    draw(rows(KINDS, [], wanted=3), tmp_path / "nothing.png")
    assert (tmp_path / "times.png").stat().st_size > (tmp_path / "nothing.png").stat().st_size > 1000


def test_the_document_gets_the_newest_table_between_its_marks_and_keeps_the_rest(tmp_path):
    document = tmp_path / "faults.md"
    document.write_text("before\n<!-- made: campaign -->\nyesterday\n<!-- end: campaign -->\nafter\n")
    for _ in range(2):
        write_document(rows(KINDS, GOOD, wanted=3), reported="a test", document=document)
    text = document.read_text()
    assert text.startswith("before\n<!-- made: campaign -->\n\na test: 6 faults of 2 kinds, 0 unsafe.\n")
    assert text.endswith("<!-- end: campaign -->\nafter\n")
    assert "yesterday" not in text
    assert text.count("| killed |") == 1
    assert (tmp_path / "pictures" / "faults.png").is_file()


@pytest.mark.parametrize(("document", "said"), [(DOCUMENT, " faults of "), (KILLS, " kills, ")])
def test_the_documents_of_this_repository_have_their_marks_around_what_is_written(document, said):
    assert said in part_of(document.read_text(), CAMPAIGN)


def test_outcomes_are_read_as_they_were_written(tmp_path):
    file = FaultCampaign().kept_in(tmp_path)
    for one in GOOD:
        file.append(one)
    assert file.read() == GOOD


def test_a_line_that_was_cut_short_is_done_again_and_nothing_else_lost(tmp_path):
    file = FaultCampaign().kept_in(tmp_path)
    file.append(GOOD[0])
    with file.path.open("a") as half:
        half.write(json.dumps(GOOD[1].to_json())[:40])
    assert file.read() == GOOD[:1]
    file.append(GOOD[2])
    assert file.read() == [GOOD[0], GOOD[2]]


def test_a_trial_done_again_counts_once_as_it_came_last(tmp_path):
    file = FaultCampaign().kept_in(tmp_path)
    file.append(outcome("killed", 1, Trouble.NO_RESULT))
    file.append(outcome("killed", 1))
    assert file.read() == [outcome("killed", 1)]


def test_outcomes_of_another_state_of_the_code_are_refused():
    refuse_other_revision(GOOD, "r1")
    with pytest.raises(OtherRevisionError, match="r1"):
        refuse_other_revision(GOOD, "r2")


def test_what_is_done_is_not_done_again_and_the_rest_in_turns_of_ten():
    campaign, trials = FaultCampaign(), [Trial("killed", seed) for seed in range(1, 41)]
    left = left_of(campaign, trials, [outcome("killed", seed) for seed in range(1, 16)])
    found = campaign.turns(left)
    assert [len(turn) for turn in found] == [10, 10, 5]
    assert found[0] == trials[15:25]
    assert campaign.turns([]) == []


def test_there_are_more_kinds_than_were_asked_for_and_each_states_what_it_promises():
    kinds = all_kinds()
    assert len(kinds) >= 25
    for kind in kinds:
        assert kind.reported, kind.code
        assert kind.recoveries, kind.code
        assert 0.0 < kind.bound_ms <= 4000.0, kind.code


def test_a_name_that_is_no_kind_is_refused():
    with pytest.raises(ValueError, match="no such kind: teapot"):
        chosen(["killed", "teapot"])


def test_no_unsafe_trial_bounds_their_share_by_the_rule_of_three():
    assert bound_text(0, 600) == ", 0 of 600: below 0.5 % at 95 %"
    assert bound_text(1, 600) == bound_text(0, 0) == ""


def test_the_time_of_forty_seeds_is_stated_from_the_trials_done():
    done = [replace(one, seconds=9.0) for one in GOOD]
    assert duration_text(done, 2) == "9.0 s a trial: 40 seeds of these 2 kinds take 0.1 h with 2 jobs"
    assert duration_text([], 2) == "no trial"
