"""Someone else's signal gated as a session gates: the duty cycle, the window, pauses, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

import tidegate

DATA = Path(__file__).parents[1] / "data" / "rpm"
THORAX = tidegate.SignalChoice(signal="thorax")
EXHALE = tidegate.AmplitudeWindow(lower=-30.0, upper=35.0, unit="percent")


def breathing(seconds=80.0, period_s=4.0, amplitude_mm=10.0, level_mm=3.0):
    time_s = np.arange(0.0, seconds, 0.04)
    value_mm = level_mm + amplitude_mm * np.sin(np.pi * time_s / period_s) ** 4
    return tidegate.Signal(name="belt", time_s=time_s, value_mm=value_mm)


def test_the_beam_is_on_at_the_end_of_exhale_alone():
    gating = tidegate.gate(breathing(), EXHALE)
    assert gating.reference_mm == pytest.approx(3.0, abs=0.2)
    values = gating.signal.value_mm
    assert values[gating.is_on].max() <= gating.window.upper
    assert values[gating.is_on].min() >= gating.window.lower
    assert 30.0 < gating.duty_percent < 80.0
    assert 10 <= len(gating.pulses_s) <= 16
    assert (np.diff(gating.pulses_s, axis=1) > 0.0).all()
    assert np.diff(gating.pulses_s, axis=1).sum() == pytest.approx(gating.is_on.sum() / 30.0, abs=0.1)
    assert 0.0 < gating.residual_mm < gating.window.upper - gating.window.lower
    assert "outside_window" in set(gating.reasons)
    assert [reason is None for reason in gating.reasons] == gating.is_on.tolist()


def test_a_breath_that_ceases_ends_the_beam():
    signal = breathing(120.0)
    stopped = signal.value_mm.copy()
    stopped[signal.time_s > 60.0] = stopped[signal.time_s > 60.0][0]
    gating = tidegate.gate(tidegate.Signal(time_s=signal.time_s, value_mm=stopped), EXHALE)
    after = gating.signal.time_s > 60.0
    assert not gating.is_on[-600:].any()
    assert gating.is_on[~after].any()


def test_a_window_in_mm_and_own_limits_count():
    wide = tidegate.AmplitudeWindow(lower=-1.0, upper=2.0)
    slow = tidegate.GateLimits(window=wide, dwell_ms=600.0)
    assert tidegate.gate(breathing(), wide, limits=slow).duty_percent < tidegate.gate(breathing(), wide).duty_percent
    assert tidegate.gate(breathing(), wide).window == wide


def test_a_recorded_vxp_is_gated():
    signal = tidegate.read_signal(next(DATA.glob("*.vxp")))
    gating = tidegate.gate(signal, EXHALE)
    assert 0.0 < gating.duty_percent < 100.0


def test_a_plain_csv_is_read(tmp_path):
    path = tmp_path / "trace.csv"
    signal = breathing(30.0)
    rows = "".join(f"{t:.3f},{v:.4f}\n" for t, v in zip(signal.time_s, signal.value_mm, strict=True))
    path.write_text(f"time_s,position_mm\n{rows}")
    found = tidegate.read_signal(path)
    assert found.name == "trace"
    np.testing.assert_allclose(found.value_mm, signal.value_mm, atol=1e-4)
    assert found.to_arrow().column_names == ["time_s", "value_mm"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"learn_s": 1.0}, "learn_s is 1"),
        ({"learn_s": 79.999}, "nothing after"),
        ({"window": tidegate.AmplitudeWindow(choice=THORAX, lower=0.0, upper=1.0)}, "window is 'on another signal"),
        ({"signal": tidegate.Signal(time_s=np.arange(3000) / 30.0, value_mm=np.zeros(3000))}, "fewer than 3 breaths"),
        (
            {"signal": tidegate.Signal(time_s=np.arange(9.0), value_mm=np.full(9, np.nan))},
            "signal is 'not measured throughout",
        ),
    ],
    ids=str,
)
def test_what_cannot_be_gated_is_refused_by_name(change, said):
    given = {"signal": breathing(), "window": EXHALE} | change
    with pytest.raises(tidegate.TidegateError, match=said):
        tidegate.gate(given.pop("signal"), given.pop("window"), **given)


@pytest.mark.parametrize(
    ("time_s", "value_mm", "said"),
    [
        ([0.0], [1.0], "time_s is .*at least two"),
        ([0.0, 1.0], [1.0], "value_mm is "),
        ([0.0, 0.0], [1.0, 1.0], "time_s is 'not increasing"),
        ([0.0, float("nan")], [1.0, 1.0], "time_s is 'not increasing"),
    ],
)
def test_a_signal_without_increasing_times_is_none(time_s, value_mm, said):
    with pytest.raises(tidegate.TidegateError, match=said):
        tidegate.Signal(time_s=time_s, value_mm=value_mm)


def test_a_file_that_is_no_trace_is_refused(tmp_path):
    with pytest.raises(tidegate.TidegateError, match=r"none.csv: cannot be read \(No such file"):
        tidegate.read_signal(tmp_path / "none.csv")
    (tmp_path / "odd.csv").write_text("hello")
    with pytest.raises(tidegate.TidegateError, match=r"odd\.csv: line 1"):
        tidegate.read_signal(tmp_path / "odd.csv")


MICROSECONDS = {"unit": "m", "time": "us", "time_unit": "us", "is_inverted": True}


@pytest.mark.parametrize(
    ("text", "given"),
    [
        ("t,abdomen\n0,1.5\n0.1,\n0.2,-2\n", {"time": "t"}),
        ("t;abdomen\n0;1,5\n0,1;\n0,2;-2\n", {"time": "t"}),
        ("x\tabdomen\tms\n9\t0.15\t500\n9\t\t600\n9\t-0.2\t700\n", {"unit": "cm", "time": "ms", "time_unit": "ms"}),
        (
            "us,abdomen\n7,-0.0015\n100007,\n200007,0.002\n",
            {"unit": "m", "time": "us", "time_unit": "us", "is_inverted": True},
        ),
    ],
)
def test_named_columns_of_a_csv_are_read_in_their_units(tmp_path, text, given):
    path = tmp_path / "other.csv"
    path.write_text(text)
    found = tidegate.read_signal(path, value="abdomen", **given)
    np.testing.assert_allclose(found.time_s, [0.0, 0.1, 0.2], atol=1e-9)
    np.testing.assert_allclose(found.value_mm, [1.5, np.nan, -2.0])
    assert found.peak_to_peak_mm == pytest.approx(3.5)


@pytest.mark.parametrize(
    ("text", "given", "said"),
    [
        ("t,a\n0,1\n1,2\n", {"value": "b"}, "value.*b.*a"),
        ("t,a,a\n0,1,1\n1,2,2\n", {"value": "a"}, "value"),
        ("t,a\n0,1\n1,2\n", {"value": "a", "time": "s"}, "time.*columns t, a"),
        ("t,a\n0,1\n1,2\n", {"value": "a", "unit": "inch"}, "unit.*mm, cm, m"),
        ("t,a\n0,1\n1,2\n", {"value": "a", "time_unit": "h"}, "time_unit"),
        ("t,a\n0,1\n1,x\n", {"value": "a"}, "line 3: t, a are '1', 'x'"),
        ("t,a\n0,1\n,2\n", {"value": "a"}, "line 3: t, a are ''"),
        ("t,a\n0,1\n", {"value": "a"}, "at least two"),
        ("t,a\n1,1\n0,2\n", {"value": "a"}, "increasing"),
        ("", {"value": "a"}, "1 to"),
    ],
)
def test_a_csv_of_another_form_is_refused_by_name(tmp_path, text, given, said):
    path = tmp_path / "other.csv"
    path.write_text(text)
    with pytest.raises(tidegate.TidegateError, match=said):
        tidegate.read_signal(path, **{"time": "t"} | given)


def test_a_real_trace_states_its_range():
    assert 10.0 < tidegate.read_signal(next(DATA.glob("*.vxp"))).peak_to_peak_mm < 30.0
