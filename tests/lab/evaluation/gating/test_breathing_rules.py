"""The rules on breathing: who is held rightly and wrongly, on courses whose breath is known by construction."""

import csv

import numpy as np
import pytest
from typer.testing import CliRunner

from engine.core.gate_state import HoldReason
from lab.evaluation.gating.breathing_rules import (
    EXHALE,
    TRIALS_EACH,
    WINDOWS,
    StoppedTrial,
    gate_course,
    gate_trace,
)
from lab.evaluation.gating.tables import recorded_table, stopped_table
from service.cli import app
from tests.support.repository import ROOT

TRACES = ROOT / "tests" / "data"
CALM = TRACES / "markers" / "201205101522-LAC-1-N-138-6.csv"
PERIOD_S = 4.0


def course(change_mm=np.zeros_like, seconds=90.0):
    at = np.arange(0.0, seconds, 1.0 / 30.0)
    breath = 10.0 * (0.5 - 0.5 * np.cos(2.0 * np.pi * at / PERIOD_S)) ** 2
    return gate_course("made", at, breath + change_mm(at), EXHALE)


def test_a_patient_who_breathes_evenly_is_honest_throughout_and_never_held():
    even = course()
    inner = (even.time_s > even.time_s[0] + PERIOD_S) & (even.time_s < even.time_s[-1] - PERIOD_S)
    assert even.is_honest[inner].all()
    assert not even.is_elsewhere.any()
    assert even.is_on[inner].mean() > 0.4
    np.testing.assert_array_equal(even.is_on, even.would_be_on)


@pytest.mark.parametrize("step_mm", [4.0, -4.0])
def test_a_patient_who_has_sunk_or_risen_is_elsewhere_and_held_but_would_be_treated(step_mm):
    moved = course(lambda at: step_mm * np.clip(at - 40.0, 0.0, 1.0))
    later = moved.time_s > 41.0 + 2.0 * PERIOD_S
    assert moved.is_elsewhere[later][: -int(PERIOD_S * 30.0)].all()
    assert not moved.is_on[later].any()
    assert not moved.is_honest[later].any()
    if step_mm < 0.0:
        assert moved.would_be_on[later].mean() > 0.2
        assert moved.is_held_by(HoldReason.BASELINE_DRIFTED)[later].any()


def test_a_pause_is_not_honest_and_is_held_until_the_next_breath():
    at = np.arange(0.0, 90.0, 1.0 / 30.0)
    breathed = np.where(at < 40.0, at, np.where(at < 60.0, 40.0, at - 20.0))
    values = 10.0 * (0.5 - 0.5 * np.cos(2.0 * np.pi * breathed / PERIOD_S)) ** 2
    paused = gate_course("made", at, values, EXHALE)
    during = (paused.time_s > 46.0) & (paused.time_s < 60.0)
    assert not paused.is_on[during].any()
    assert paused.would_be_on[during].all()
    assert not paused.is_honest[during].any()
    assert paused.is_held_by(HoldReason.BREATHING_IRREGULAR)[during].all()
    assert paused.is_on[paused.time_s > 66.0].any()


def test_the_table_of_recorded_courses_fails_where_the_rules_hold_honest_time():
    calm = gate_trace(CALM, "exhale")
    table = recorded_table("exhale", calm)
    assert not table.failed
    *_, total = table.rows
    assert total[0] == "all"
    assert total[2] > 90.0
    assert total[3:6] == (0.0, 0.0, 0.0)
    (one,) = calm
    spoilt = type(one)(
        **{name: getattr(one, name) for name in one.__dataclass_fields__}
        | {"is_on": one.is_on & (one.time_s > 70.0), "reasons": (HoldReason.BASELINE_DRIFTED,) * len(one.reasons)}
    )
    assert recorded_table("exhale", [spoilt]).failed == {1}


def test_the_table_of_trials_has_the_worst_of_each_kind():
    trials = [
        StoppedTrial(kind="apnoea", on_s=3.0, free_on_s=20.0),
        StoppedTrial(kind="apnoea", on_s=5.0, free_on_s=10.0),
        StoppedTrial(kind="drift", on_s=1.0, free_on_s=1.0, drift_mm=2.0, free_drift_mm=4.0),
    ]
    assert stopped_table(trials).rows == (
        ("apnoea", 2, 4.0, 5.0, 20.0, None, None),
        ("drift", 1, 1.0, 1.0, 1.0, 2.0, 4.0),
    )


def test_every_event_ends_the_beam_and_without_the_rules_it_would_stay(tmp_path):
    """The command with one volunteer, whose breath lasts 4 s."""
    options = ["--rules-only", "--volunteer", "1", "--trace", str(CALM), "--out", str(tmp_path), "--strict"]
    result = CliRunner().invoke(app, ["evaluate", "gate", *options])
    assert result.exit_code == 0, result.output
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {"gate_rules_trials.csv", *(f"gate_rules_{name.replace(' ', '_')}.csv" for name in WINDOWS)}
    with (tmp_path / "gate_rules_trials.csv").open() as file:
        _, *rows = csv.reader(file)
    longest, free = ([float(row[column]) for row in rows] for column in (3, 4))
    assert len(rows) == TRIALS_EACH
    assert max(longest) < 3.0 * 4.5
    assert max(free) == pytest.approx(30.0, abs=0.5)
    drifts = [(float(row[5]), float(row[6])) for row in rows if row[5]]
    assert len(drifts) == TRIALS_EACH - 5
    assert max(mm for mm, _ in drifts) < 5.0 < max(mm for _, mm in drifts)


def test_a_trace_that_cannot_be_read_is_refused_with_its_name(tmp_path):
    broken = tmp_path / "broken.csv"
    broken.write_text("a;b\n1;2\n")
    result = CliRunner().invoke(
        app, ["evaluate", "gate", "--rules-only", "--out", str(tmp_path / "out"), "--trace", str(broken)]
    )
    assert result.exit_code == 2
    assert "broken.csv" in result.output
    assert not (tmp_path / "out").exists()
