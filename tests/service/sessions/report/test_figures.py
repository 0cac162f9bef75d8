"""Figures of a report from samples that were made up: what each is of, and what is left out."""

from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import pyarrow as pa
import pytest

from service.core.schemas.reports import ReportEvent, ReportWindow
from service.sessions.report.figures import read_columns, report_figures
from service.sessions.report.pages import _breathing
from service.sessions.report.picture import COLUMNS, LEFT, trace_svg
from service.storage.samples.layout import SampleHead

SCHEMA = SampleHead(session_id="0" * 32).schema
PERIOD_NS = 33_333_333


def rows(gates, *, step_ns=PERIOD_NS, **columns):
    """Samples with these states of the gate, and these columns: a value for all, or a list."""
    n = len(gates)
    plain = {"timestamp_us": 0, "missed_frames": 0, "state": "measuring", "line_on": False, "received_ns": 0}
    plain |= {"asserted_ns": 1_000_000, "captured_ns": 0} | columns
    made = {name: value if isinstance(value, list) else [value] * n for name, value in plain.items()}
    made |= {"frame_index": list(range(n)), "gate": list(gates)}
    made.setdefault("decided_ns", [step_ns * i for i in range(n)])
    made.setdefault("hold_reason", [None if gate == "beam_on" else "outside_window" for gate in gates])
    return pa.RecordBatch.from_arrays(
        [pa.array(made.get(field.name, [None] * n), field.type) for field in SCHEMA], schema=SCHEMA
    )


def figures(*batches):
    return report_figures(*read_columns(batches))


def test_a_pulse_goes_on_over_the_end_of_a_batch_and_a_gap_counts_a_second_at_most():
    later = rows(["beam_on", "hold"], decided_ns=[2 * 10**8, 3 * 10**8], signal_mm=[1.5, None])
    found = figures(rows(["hold", "beam_on"], step_ns=10**8, signal_mm=1.0), later)
    (pulse,) = found.pulse_list
    assert (pulse.from_s, pulse.to_s, pulse.seconds, pulse.spread) == (0.1, 0.3, 0.2, 0.5)
    assert found.pulses == 1
    gap = figures(rows(["beam_on", "beam_on", "disarmed"], step_ns=5 * 10**9))
    assert (gap.beam_on_s, gap.recorded_s) == (2.0, 2.0)


def test_motion_is_of_the_frames_with_the_beam_on_alone_and_around_its_own_mean():
    found = figures(rows(["beam_on"] * 4 + ["hold"] * 2, whole_mm=[1.0, 1.0, 3.0, None, 50.0, -50.0]))
    (whole,) = found.motion
    assert (whole.signal, whole.mean_mm, whole.frames) == ("whole", 1.67, 3)
    assert whole.deviation_mm == pytest.approx(0.94)


def test_breathing_has_its_median_and_the_range_of_nine_tenths():
    rates = [12.0, 15.0, 20.0, 0.0, None]
    found = figures(rows(["hold"] * 5, rate_per_min=rates, breath_amplitude=[8.0, None, 10.0, 9.0, 9.0]))
    assert (found.period_s.median, found.period_s.low, found.period_s.high) == (4.0, 3.1, 4.9)
    assert found.amplitude.median == 9.0


def test_the_baseline_is_that_of_the_first_and_of_the_last_half_minute():
    n = 100
    found = figures(rows(["hold"] * n, step_ns=10**9, breath_baseline=[float(i) for i in range(n)]))
    assert (found.baseline_first, found.baseline_last) == (15.0, 84.0)


def test_a_hold_is_counted_when_it_begins_and_again_for_another_reason():
    reasons = ["outside_window", "outside_window", "marker_lost", None, "marker_lost"]
    found = figures(rows(["hold", "hold", "hold", "beam_on", "hold"], step_ns=10**9, hold_reason=reasons))
    assert {one.reason: (one.count, one.seconds) for one in found.holds} == {
        "outside_window": (1, 2.0),
        "marker_lost": (2, 1.0),
    }


def test_a_session_without_samples_has_no_figures_and_no_picture():
    found = figures()
    assert (found.frames, found.duty_percent, found.pulse_s, found.motion, found.holds) == (0, None, None, [], [])
    assert trace_svg(read_columns([])[0]) == ""


def line_of(picture):
    """The steps of the signal's line: it alone has no dashes and many points."""
    return max((one.partition('"')[0] for one in picture.split('d="')[1:]), key=len)


def test_a_long_trace_is_one_line_through_the_least_and_the_most_of_each_column():
    n = 20 * COLUMNS
    spike = [0.0] * n
    spike[7777] = 9.0
    columns, _ = read_columns([rows(["hold"] * n, signal_mm=spike)])
    picture = trace_svg(columns)
    line = line_of(picture)
    assert line.count("M") == 1, "one line, without gaps"
    heights = [float(one.split()[1]) for one in line[1:].split(" L")]
    assert len(heights) <= 4 * COLUMNS
    assert sum(one < max(heights) for one in heights) == 1, "one point reaches up to the spike"


def test_a_gap_of_the_samples_is_a_gap_of_the_line_and_the_window_ends_where_another_begins():
    begin = datetime(2026, 11, 21, 9, 0, tzinfo=UTC)
    windows = [
        ReportWindow(at=begin, actor="A", text="", reason="", lower=-1.0, upper=3.0),
        ReportWindow(at=begin + timedelta(seconds=2), actor="A", text="", reason="", lower=0.0, upper=4.0),
    ]
    event = ReportEvent(at=begin + timedelta(seconds=2), actor="A", action="session.window", text="window set")
    times_ns = [0, 5 * 10**8, 10**9, 35 * 10**8, 4 * 10**9]
    columns, _ = read_columns([rows(["hold"] * 5, signal_mm=[1.0, 2.0, 1.0, 2.0, 1.0], decided_ns=times_ns)])
    picture = trace_svg(columns, windows, [event], begin)
    assert line_of(picture).count("M") == 2
    middle = f"{LEFT + COLUMNS / 2:.1f}"
    assert picture.count(f"H{middle}") == picture.count(f'd="M{middle}') - 1 == 2, "two edges end, two begin, one mark"
    assert ">mm<" in picture


@pytest.mark.parametrize(("signal", "unit"), [("volume", "l"), ("whole", "mm")])
def test_breathing_is_in_the_unit_of_the_gated_signal(signal, unit):
    found = figures(rows(["hold"] * 3, breath_amplitude=0.5, breath_baseline=0.1))
    window = SimpleNamespace(signal=signal)
    stated = dict(_breathing(SimpleNamespace(session=SimpleNamespace(window=window), figures=found)))
    assert stated["amplitude, median (5 to 95 %)"] == f"0.50 (0.50 to 0.50) {unit}"
    assert stated["end of exhale, first to last 30 s"] == f"+0.10 to +0.10 {unit}"


def test_named_regions_have_figures_of_their_own_under_their_names():
    named = [[1.0, 5.0], [3.0, float("nan")], [99.0, 99.0], None]
    batch = rows(["beam_on", "beam_on", "hold", "beam_on"], named_mm=named)
    found = report_figures(*read_columns([batch]), ("belly", "scar"))
    assert [(one.signal, one.mean_mm, one.frames) for one in found.motion] == [("belly", 2.0, 2), ("scar", 5.0, 1)]
