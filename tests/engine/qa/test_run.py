"""Whole runs: a healthy set-up passes twenty of twenty times, each seeded fault fails its check, an early end is safe.

The seeds and one healthy run go through the very pipeline, frame by frame. For twenty runs that is too long: there the
plate is one of four, and the phantom's motion is what the pipeline made of it, with that run's own errors shuffled, at
other times, with other computing times and another zero.
"""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from engine.core.errors import InvalidValueError, RecordingError
from engine.qa.bounds import QaBaseline, QaBounds
from engine.qa.checks import checks_of
from engine.qa.drill import drill_line
from engine.qa.inputs import QaInputs
from engine.qa.phantom import figures_of, run_of
from engine.qa.results import QaBound, QaKind, QaNeed, QaReport, QaVerdict
from engine.qa.run import _total, judge_all, measure_plate, run_qa
from lab.virtual_qa import (
    SLIDE_S,
    VIRTUAL_BASELINE,
    RigFaults,
    VirtualPlate,
    virtual_beam,
    virtual_phantom,
    virtual_plate,
)
from tests.support.qa.altered_plate import Altered
from tests.support.qa.faulty_lines import Line, NeverLatches, beam_of
from tests.support.qa.phantom_frames import watched

pytestmark = [pytest.mark.long, pytest.mark.slow, pytest.mark.verification]

PLATE_S = 12.0
RUNS, BATCHES, PLATES = 20, 2, 4
FAULTY_RUNS = 4
BLOCK = 45


def run(inputs, kind=QaKind.ANNUAL, **given):
    return run_qa(kind, inputs, **{"bounds": QaBounds(), "baseline": VIRTUAL_BASELINE, **given})


def quick(faults=None, *, seed=7):
    """A set-up with a phantom that takes less long."""
    faults = faults or RigFaults()
    phantom = virtual_phantom(faults, seed=seed, periods_s=(2.3, 5.3), cycles_each=4)
    return QaInputs(plate=virtual_plate(faults, seed=seed, seconds=PLATE_S), phantom=phantom, beam=virtual_beam(5))


def beyond(report, verdict):
    return {result.code for result in report.results if result.verdict is verdict}


def values(report):
    return {result.code: result.value for result in report.results}


@pytest.fixture(scope="module")
def healthy():
    reported = []
    report = run(
        QaInputs(
            plate=virtual_plate(seed=11, seconds=PLATE_S),
            phantom=virtual_phantom(seed=11, cycles_each=2),
            beam=virtual_beam(),
        ),
        on_progress=lambda stage, done, total: reported.append((stage, done, total)),
    )
    return report, reported


@pytest.mark.slow
def test_a_healthy_set_up_passes_every_check_of_the_annual_run(healthy):
    report, _ = healthy
    assert beyond(report, QaVerdict.FAIL) == beyond(report, QaVerdict.WARN) == set()
    assert report.verdict is QaVerdict.PASS
    measured = [check.code for check in checks_of(QaKind.ANNUAL) if check.code != "treatment_beam_off_ms"]
    assert [result.code for result in report.results] == measured, "treatments are added by the service"


@pytest.mark.slow
def test_a_run_reports_how_far_it_is_stage_after_stage(healthy):
    _, reported = healthy
    stages = list(dict.fromkeys(stage for stage, _, _ in reported))
    assert stages == [QaNeed.PLATE, QaNeed.PHANTOM, QaNeed.BEAM]
    for stage in stages:
        done = [number for one, number, _ in reported if one is stage]
        assert done == sorted(done)
    assert reported[-1] == (QaNeed.BEAM, 50, 50)


@pytest.mark.slow
def test_a_run_brings_what_its_plots_show(healthy):
    report, _ = healthy
    assert [series.code for series in report.series] == [
        "plate_distance",
        "commanded_measured",
        "gate_intervals",
        "gate_lengths",
    ]


@pytest.mark.slow
def test_a_seeded_offset_of_2_mm_fails_where_the_camera_hangs_and_how_true_the_motion_is():
    """One sign each of offset and duty: both signs are tested in test_plate.py, test_motion.py and test_sine.py."""
    report = run(quick(RigFaults(offset_mm=2.0)))
    assert {"camera_distance_mm", "motion_offset_mm", "motion_error_mm"} <= beyond(report, QaVerdict.FAIL)
    assert report.verdict is QaVerdict.FAIL
    assert values(report)["motion_offset_mm"] > 0.0
    assert not {"motion_lag_ms", "gate_mean_delay_ms", "camera_tilt_x_deg"} & beyond(report, QaVerdict.FAIL)


@pytest.mark.slow
def test_a_seeded_delay_of_150_ms_fails_the_lag_and_the_gate_s_delays_and_nothing_else():
    report = run(quick(RigFaults(delay_ms=150.0)))
    late = {"motion_lag_ms", "gate_mean_delay_ms", "gate_delay_on_ms", "gate_delay_off_ms", "beam_off_total_ms"}
    assert beyond(report, QaVerdict.FAIL) == late | {"beam_outside_ms"}
    assert values(report)["motion_lag_ms"] == pytest.approx(150.0, abs=8.0)


@pytest.mark.slow
def test_a_seeded_change_of_the_duty_cycle_by_3_percent_fails_it_and_nothing_else():
    report = run(quick(RigFaults(duty_change_percent=-3.0)))
    assert beyond(report, QaVerdict.FAIL) == {"duty_cycle_change_percent"}
    assert values(report)["duty_cycle_change_percent"] == pytest.approx(-3.0, abs=0.8)


@pytest.mark.slow
@pytest.mark.parametrize("batch", range(BATCHES))
def test_twenty_healthy_runs_of_twenty_pass(healthy, batch):
    errors_mm = _errors_mm(healthy[0])
    seeds = range(batch * RUNS // BATCHES, (batch + 1) * RUNS // BATCHES)
    assert len(seeds) * BATCHES == RUNS
    bad = {seed: [result for result in _another_run(errors_mm, seed) if result.verdict != "pass"] for seed in seeds}
    assert not any(bad.values()), bad


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "failing"),
    [
        ({"delay_s": 0.15}, "gate_mean_delay_ms"),
        ({"level_mm": 2.0}, "motion_offset_mm"),
        ({"level_mm": -0.94}, "duty_cycle_change_percent"),
        ({"level_mm": 0.94}, "duty_cycle_change_percent"),
    ],
)
def test_what_passes_twenty_times_fails_every_time_with_a_fault(healthy, fault, failing):
    errors_mm = _errors_mm(healthy[0])
    for seed in range(FAULTY_RUNS):
        figures = _phantom_figures(errors_mm, seed, **fault)
        results = judge_all(QaKind.ANNUAL, figures, QaBounds(), VIRTUAL_BASELINE)
        found = next(result for result in results if result.code == failing)
        assert (found.verdict, found.value is None) == ("fail", False), found


def _one_off_late(run, late_s=0.5):
    """The same beam, but that it went off late once; the middle one of the run."""
    return _with_beam(run, lambda number, on_s, off_s: (on_s, off_s + late_s * (number == len(run.intervals_s) // 2)))


def _one_pulse_outside(run, length_s=0.3):
    """The same beam, but for one pulse while the phantom is at its farthest from the window."""
    gaps = [(0.5 * (off_s + on_s), on_s - off_s) for (_, off_s), (on_s, _) in pairwise(run.intervals_s)]
    middle_s = gaps[len(gaps) // 2][0]
    pulse = (middle_s - 0.5 * length_s, middle_s + 0.5 * length_s)
    return replace(
        run,
        intervals_s=tuple(sorted((*run.intervals_s, pulse))),
        undwelt_s=tuple(sorted((*run.undwelt_s, pulse))),
    )


def _still_on_at_the_end(run):
    """The same beam, but that it never went off after the last time it went on."""
    kept = len(run.intervals_s) - 1
    return replace(
        run,
        intervals_s=run.intervals_s[:kept],
        undwelt_s=run.undwelt_s[:kept],
        still_on_s=run.intervals_s[kept][0],
    )


def _with_beam(run, change):
    changed = [
        tuple(change(number, *pair) for number, pair in enumerate(pairs)) for pairs in (run.intervals_s, run.undwelt_s)
    ]
    return replace(run, intervals_s=changed[0], undwelt_s=changed[1])


@pytest.mark.slow
@pytest.mark.parametrize("beam", [_one_off_late, _one_pulse_outside, _still_on_at_the_end])
def test_a_beam_that_is_on_outside_of_the_window_even_once_fails_every_time(healthy, beam):
    errors_mm = _errors_mm(healthy[0])
    for seed in range(FAULTY_RUNS):
        figures = _phantom_figures(errors_mm, seed, beam=beam)
        for kind in (QaKind.MONTHLY, QaKind.ANNUAL):
            results = {result.code: result for result in judge_all(kind, figures, QaBounds(), VIRTUAL_BASELINE)}
            found = results["beam_outside_ms"]
            assert (found.verdict, found.value is None) == ("fail", False), (kind, found)


def _errors_mm(report: QaReport):
    """What the pipeline's motion was off by in a real run, frame by frame, without its zero's own error."""
    commanded, measured = next(series for series in report.series if series.code == "commanded_measured").curves
    errors_mm = np.array(measured.y) - np.array(commanded.y)
    return errors_mm - errors_mm.mean()


def _another_run(errors_mm, seed):
    """Judge another plate, another phantom's frames and another drill."""
    figures = [*_plate_figures(seed % PLATES), *_phantom_figures(errors_mm, seed)]
    figures += drill_line(virtual_beam(5), lambda _done: None)
    figures.append(_total(figures))
    return judge_all(QaKind.ANNUAL, figures, QaBounds(), VIRTUAL_BASELINE)


@cache
def _plate_figures(number):
    """What a plate of its own noise measures: a second of computing."""
    figures, _ = measure_plate(virtual_plate(seed=1000 + number, seconds=PLATE_S), lambda _frames: None)
    return tuple(figures)


def _phantom_figures(errors_mm, seed, *, delay_s=0.0, level_mm=0.0, beam=lambda run: run):
    """What another phantom's frames tell, with the errors of a real run in another order."""
    rng = np.random.default_rng((seed, 50))

    def error_mm(time_s):
        starts = rng.integers(0, len(errors_mm) - BLOCK, len(time_s) // BLOCK + 1)
        shuffled = np.concatenate([errors_mm[start : start + BLOCK] for start in starts])[: len(time_s)]
        zero_mm = float(rng.choice(errors_mm))
        return shuffled - zero_mm + np.where(time_s > SLIDE_S[1], level_mm, 0.0)

    given, frames = watched(
        virtual_phantom(),
        error_mm=error_mm,
        delay_s=delay_s,
        zero_s=float(rng.uniform(12.0, 18.0)),
        phase_s=float(rng.uniform(0.0, 0.033)),
        computing_ns=rng.uniform(4e6, 30e6, 10_000),
        jitter_s=rng.uniform(-2e-4, 2e-4, 10_000),
    )
    return figures_of(given, beam(run_of(given, frames)))


# What ends early, or lacks something.


class Untouched:
    """A source, or a line, that nobody may open."""

    def __getattr__(self, name):
        pytest.fail(f"{name} was asked of what is not needed")


@pytest.mark.parametrize(
    ("kind", "missing"),
    [("daily", "plate"), ("daily", "beam"), ("monthly", "phantom"), ("annual", "phantom"), ("annual", "plate")],
)
def test_a_run_that_lacks_something_is_refused_by_name_before_anything_is_opened(kind, missing):
    inputs = quick()
    beam = replace(inputs.beam, line=Untouched())
    closed = QaInputs(
        plate=replace(inputs.plate, source=Untouched()), phantom=replace(inputs.phantom, source=Untouched()), beam=beam
    )
    with pytest.raises(InvalidValueError) as refusal:
        run(replace(closed, **{missing: None}), QaKind(kind))
    assert refusal.value.field == missing


def test_a_daily_run_needs_no_phantom_and_does_not_touch_one():
    inputs = quick()
    report = run(replace(inputs, phantom=replace(inputs.phantom, source=Untouched())), QaKind.DAILY)
    assert report.verdict is QaVerdict.PASS


def test_a_site_s_bounds_and_its_missing_baseline_decide():
    inputs = quick()
    tight = QaBounds(chosen={"plate_noise_mm": QaBound(warn=0.01, fail=0.02)})
    report = run(inputs, QaKind.DAILY, bounds=tight, baseline=QaBaseline())
    assert beyond(report, QaVerdict.FAIL) == {
        "plate_noise_mm",
        "camera_distance_mm",
        "camera_tilt_x_deg",
        "camera_tilt_y_deg",
    }


def test_a_phantom_that_stands_still_fails_its_checks_and_the_others_are_judged():
    inputs = quick()
    still = replace(inputs.phantom, source=VirtualPlate(lambda _at_s: 0.0, PLATE_S, 3))
    report = run(replace(inputs, phantom=still))
    results = {result.code: result for result in report.results}
    assert "not enough to learn" in results["motion_offset_mm"].detail
    assert results["camera_distance_mm"].verdict is QaVerdict.PASS
    assert results["fail_safe_lease_ms"].verdict is QaVerdict.PASS
    assert results["beam_off_total_ms"].verdict is QaVerdict.FAIL


def test_a_recording_that_is_damaged_fails_its_checks_is_closed_and_the_line_is_drilled_all_the_same():
    inputs = quick()
    source = Altered(inputs.phantom.source, fails_at=50, error=RecordingError("damaged at frame 50"))
    report = run(replace(inputs, phantom=replace(inputs.phantom, source=source)), QaKind.MONTHLY)
    results = {result.code: result for result in report.results}
    assert "damaged at frame 50" in results["gate_mean_delay_ms"].detail
    assert results["fail_safe_hold_ms"].verdict is QaVerdict.PASS
    assert source.closed == 1


def test_a_line_that_fails_its_drill_fails_the_run():
    report = run(replace(quick(), beam=beam_of(NeverLatches)), QaKind.DAILY)
    assert report.verdict is QaVerdict.FAIL
    assert "fail_safe_fault_ms" in beyond(report, QaVerdict.FAIL)


@pytest.mark.parametrize(("stage", "at"), [("plate", 30), ("phantom", 30), ("beam", 0), ("beam", 7)])
def test_a_run_that_is_cancelled_closes_what_is_open_and_goes_no_further(stage, at):
    inputs = quick()
    plate, phantom = Altered(inputs.plate.source), Altered(inputs.phantom.source)
    beam = beam_of(Line)
    # A plate's frames are phantom enough for thirty frames.
    given = QaInputs(
        plate=replace(inputs.plate, source=plate),
        phantom=replace(inputs.phantom, source=phantom, seconds=10.0),
        beam=beam,
    )

    def cancel(now, done, _total):
        if (now, done) == (stage, at):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(given, QaKind.MONTHLY, on_progress=cancel)
    assert plate.opened == plate.closed == 1
    assert phantom.opened == phantom.closed == (0 if stage == "plate" else 1)
    assert not beam.line.is_on()
    assert beam.line.calls == [] if stage != "beam" else beam.line.calls[-2:] == ["close", "hold"]
