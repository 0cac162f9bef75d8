"""The bench of the breathing monitor: labels are looked up as they should be, and the command prints and writes it."""

import csv

import numpy as np
import pytest
from typer.testing import CliRunner

from engine.core.breath import BreathEventKind
from engine.core.errors import InvalidValueError
from lab.evaluation.breathing import bench
from lab.evaluation.breathing.bench import (
    AFTER_S,
    FIRST_SEED,
    Finding,
    ScoredSignal,
    check_plan,
    false_alarms,
    match_episodes,
    phase_errors,
    plan,
    wilson,
)
from lab.evaluation.breathing.recorded import RpmConventions, compare_flags, monitor_trace
from lab.evaluation.breathing.tables import tables_of
from lab.evaluation.breathing.trials import (
    MonitorOutput,
    Span,
    Trial,
    make_trial,
    run_monitor,
    true_phase,
)
from lab.phantom.episodes import Episode
from service.cli import app
from tests.support.repository import DATA

pytestmark = pytest.mark.slow

RPM = DATA / "rpm" / "PT01_PT09-2_13112021.vxp"
MARKERS = DATA / "markers" / "201205101522-LAC-1-N-138-6.csv"
TIMES = np.arange(0.0, 100.0, 0.1)


def trial(*episodes):
    peaks = np.arange(1.0, 100.0, 4.0)
    return Trial(name="t", period_s=4.0, time_s=TIMES, value_mm=0.0 * TIMES, episodes=tuple(episodes), peaks_s=peaks)


def output(*spans, phase=None):
    nothing = np.full(len(TIMES), np.nan)
    phases = nothing if phase is None else phase
    return MonitorOutput(
        phase_percent=phases, phase_confidence=nothing, rate_per_min=nothing, baseline_mm=nothing, spans=spans
    )


def span(kind, start, end):
    return Span(kind=BreathEventKind(kind), start_s=start, end_s=end, confidence=0.9)


COUGH = Episode(kind="cough", start_s=40.0, end_s=42.0)


@pytest.mark.parametrize(
    ("said", "delay"),
    [
        ((span("cough", 40.5, 43.0),), 0.5),
        ((span("cough", 44.9, 46.0),), 4.9),
        ((span("cough", 45.1, 46.0),), None),
        ((span("cough", 30.0, 39.9),), None),
        ((span("cough", 30.0, 40.1),), 0.0),
        ((span("sigh", 40.5, 43.0),), None),
        ((), None),
    ],
)
def test_a_label_is_found_by_its_own_kind_while_it_lasts_or_a_little_later(said, delay):
    (finding,) = match_episodes(trial(COUGH), output(*said))
    assert finding.delay_s == (None if delay is None else pytest.approx(delay))
    assert finding.cycles == (None if delay is None else pytest.approx(delay / 4.0))


def test_an_event_outside_of_the_truth_is_a_false_alarm_of_any_kind():
    said = (span("sigh", 39.0, 41.0), span("drift", 41.0, 99.0), span("sigh", 42.0 + AFTER_S + 0.1, 70.0))
    assert false_alarms(trial(COUGH), output(*said)) == [said[0], said[2]]
    assert len(false_alarms(trial(), output(*said))) == 3


def test_the_true_phase_is_linear_between_ends_of_inhale():
    phase = true_phase(trial())
    assert np.isnan(phase[:10]).all()
    assert phase[10:51:10] == pytest.approx([0.0, 25.0, 50.0, 75.0, 0.0], abs=1e-6)


def test_an_error_of_the_phase_goes_the_short_way_round():
    late = (true_phase(trial()) + 98.0) % 100.0
    assert phase_errors(trial(), output(phase=late)) == pytest.approx(-2.0)
    assert phase_errors(trial(), output()).size == 0


def test_the_interval_is_wilsons():
    assert wilson(95, 100) == pytest.approx((0.8882, 0.9785), abs=1e-4)
    assert wilson(0, 0) == (0.0, 1.0)
    assert wilson(10, 10)[1] == 1.0


def test_the_plan_reports_on_other_seeds_than_it_was_tuned_on_and_drifts_go_both_ways():
    planned = plan(2, 1.0)
    assert min(job.seed for job in planned) == FIRST_SEED
    assert sum(job.seconds for job in planned if job.group == "regular") == 3600.0
    rates = {job.drift_mm_s for job in planned if job.drift_mm_s is not None}
    assert rates == {sign * rate for sign in (1.0, -1.0) for rate in (0.1, 0.2, 0.4, 0.74)}
    assert {job.volunteer for job in planned} == set(range(1, 11))


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ((-1, 1.0, 1), "seeds is -1: must be a whole number from 0 to 100"),
        ((101, 1.0, 1), "seeds is 101"),
        ((1, float("nan"), 1), "hours is nan: must be a number from 0 to 100"),
        ((1, 1.0, 0), "jobs is 0: must be a whole number from 1 to 64"),
    ],
)
def test_numbers_out_of_bounds_are_refused(numbers, words):
    with pytest.raises(InvalidValueError, match=words):
        check_plan(*numbers)


def scored(group, findings=(), alarms=(), drift=None):
    (job,) = [job for job in plan(2, 1.0) if job.group == group and (drift is None or job.drift_mm_s == drift)][:1]
    return ScoredSignal(
        job=job,
        findings=findings,
        false_alarms=alarms,
        phase_errors=np.array([1.0, -3.0]),
        phase_share=1.0,
        rate_error_per_min=0.2,
    )


def test_a_mark_that_is_missed_is_red_and_one_that_is_met_is_not():
    hit = Finding(kind="cough", delay_s=0.5, cycles=0.1)
    miss = Finding(kind="cough", delay_s=None, cycles=None)
    slow = Finding(kind="drift", delay_s=13.0, cycles=3.1)
    alarm = span("sigh", 50.0, 51.0)
    events, drift, regular = tables_of(
        [scored("cough", (hit,) * 18 + (miss,) * 2), scored("drift 0.1", (slow,), drift=0.1), scored("regular")]
    )
    assert events.failed == {0}
    assert events.rows[0][:4] == ("cough", 20, 18, 0.9)
    assert drift.failed == {0}
    assert drift.rows[0][:3] == ("0.1 mm/s up", 1, 0)
    assert regular.failed == frozenset()
    many = tables_of([scored("cough", (hit,) * 19 + (miss,)), scored("regular", alarms=(alarm,) * 3)])
    assert many[0].failed == frozenset()
    assert many[2].failed == {3}
    assert many[2].rows[3] == ("false alarms in ten minutes", 1.5)


def test_a_simulated_cough_is_detected():
    made = make_trial(1, FIRST_SEED, ("cough",), 60.0)
    said = run_monitor(made.time_s, made.value_mm)
    (finding,) = match_episodes(made, said)
    assert finding.delay_s < 1.0
    assert false_alarms(made, said) == []


def test_an_agreement_is_by_samples_and_beyond_chance():
    fault = np.array([True, True, False, False])
    theirs = np.array([True, False, False, False])
    found = compare_flags("no phase", fault, theirs, np.array([np.nan, np.nan, 2.0, 4.0]))
    assert (found.both, found.theirs_only, found.ours_only, found.neither) == (0.25, 0.0, 0.25, 0.5)
    assert found.kappa == pytest.approx(0.5)
    assert found.phase_error == pytest.approx(3.0)


def test_an_rpm_agrees_on_the_phase_where_both_tell_one_and_its_sense_is_an_option():
    right = monitor_trace(RPM, RpmConventions()).rpm[0]
    turned = monitor_trace(RPM, RpmConventions(zero="exhale")).rpm[0]
    assert right.phase_error < 10.0
    assert turned.phase_error > 35.0
    assert right.theirs_only + right.both > 0.2
    assert monitor_trace(RPM, RpmConventions(not_periodic=5)).rpm[0].both == 0.0


def test_the_command_prints_and_writes_tables_and_pictures(tmp_path):
    arguments = ["evaluate", "breathing", "--seeds", "0", "--hours", "0", "--out", str(tmp_path / "out")]
    outcome = CliRunner().invoke(app, [*arguments, "--trace", str(RPM), "--trace", str(MARKERS)])
    assert outcome.exit_code == 0, outcome.output
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {
        *("breathing_traces.csv", "breathing_recorded.csv", "breathing_rpm.csv"),
        *(f"{RPM.name}.png", f"{MARKERS.name}.png"),
    }
    assert (tmp_path / "out" / f"{RPM.name}.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    with (tmp_path / "out" / "breathing_traces.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["trace"] for row in rows] == [RPM.name, MARKERS.name]
    assert float(rows[1]["rate, median [1/min]"]) == pytest.approx(9.0, abs=1.0)
    assert "Agreement with the RPM" in outcome.output


@pytest.mark.slow
def test_the_bench_runs_in_processes_and_names_every_kind(tmp_path, monkeypatch):
    """With four of the ten volunteers; `tidegate evaluate breathing` takes all."""
    few = [job for job in plan(1, 0.4) if job.volunteer in {1, 4, 7, 10}]
    monkeypatch.setattr(bench, "plan", lambda _seeds, _hours: few)
    arguments = ["evaluate", "breathing", "--seeds", "1", "--hours", "0.4", "--jobs", "2", "--out", str(tmp_path)]
    outcome = CliRunner().invoke(app, arguments)
    assert outcome.exit_code == 0, outcome.output
    with (tmp_path / "breathing_events.csv").open() as file:
        rows = {row["event"]: row for row in csv.DictReader(file)}
    assert set(rows) == {"cough", "sigh", "apnoea", "talking", "irregular", "drift"}
    assert all(float(row["sensitivity"]) >= 0.9 for row in rows.values())
    with (tmp_path / "breathing_regular.csv").open() as file:
        values = dict(csv.reader(file))
    assert float(values["false alarms in ten minutes"]) <= 1.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--seeds", "1000"], "seeds is 1000: must be a whole number from 0 to 100"),
        (["--rpm-zero", "middle"], "rpm_zero is 'middle': must be inhale or exhale"),
        (["--rpm-flag", "-1"], "rpm_flag is -1: must be from -9 to 9"),
        (["--jobs", "0"], "jobs is 0: must be a whole number from 1 to 64"),
        (["--trace", "missing.vxp"], "missing.vxp: cannot be read"),
    ],
)
def test_the_command_refuses_in_one_line(tmp_path, arguments, words):
    outcome = CliRunner().invoke(app, ["evaluate", "breathing", "--out", str(tmp_path / "x"), *arguments])
    assert outcome.exit_code == 2
    assert words in outcome.stderr
    assert len(outcome.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "x").exists()
