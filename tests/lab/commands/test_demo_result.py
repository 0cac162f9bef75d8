"""What `make demo` prints: expected beside measured."""

import csv

import numpy as np
import pytest

from lab.commands.demo.result import DemoWindow, beam_on, compare, result_of
from lab.phantom.truth import Truth

FPS = 30.0
TRUE_US = (np.arange(1800) * 1e6 / FPS).astype(np.int64)
BREATH_MM = 5.0 * (1.0 - np.cos(2.0 * np.pi * TRUE_US / 4e6)) / 2.0
DEPTH_MM = 900.0 - BREATH_MM
ARMED = slice(400, None)


@pytest.mark.parametrize("offset_mm", [0.0, 2.5, -0.3])
def test_a_shifted_reference_is_named_as_such_and_is_no_motion_error(offset_mm):
    found = compare(TRUE_US[ARMED], BREATH_MM[ARMED] + offset_mm, TRUE_US, DEPTH_MM)
    assert found.reference_mm == pytest.approx(offset_mm, abs=1e-3)
    assert np.abs(found.errors_mm).max() < 1e-9


def test_a_frame_that_is_wrong_counts_by_as_much():
    motion_mm = BREATH_MM[ARMED].copy()
    motion_mm[700] += 1.0
    found = compare(TRUE_US[ARMED], motion_mm, TRUE_US, DEPTH_MM)
    assert np.abs(found.errors_mm).max() == pytest.approx(1.0, abs=1e-3)
    assert int(np.abs(found.errors_mm).argmax()) == 700


def test_too_small_an_amplitude_is_a_motion_error():
    found = compare(TRUE_US[ARMED], 0.9 * BREATH_MM[ARMED], TRUE_US, DEPTH_MM)
    assert np.abs(found.errors_mm).max() == pytest.approx(0.25, abs=0.02)


def test_without_an_end_of_exhale_there_is_no_figure():
    assert compare(TRUE_US[:40], BREATH_MM[:40], TRUE_US, DEPTH_MM) is None


WINDOW = DemoWindow(lower_mm=-1.0, upper_mm=2.0, hysteresis_mm=0.5, dwell_s=0.1)
FRAME_US = 1e6 / FPS


@pytest.mark.parametrize(
    ("levels_mm", "is_on"),
    [
        ([0.0] * 6, [False, False, False, True, True, True]),
        ([1.8] * 6, [False] * 6),  # inside, but not by the hysteresis
        ([0.0, 0.0, 0.0, 0.0, 1.8, 2.1, 0.0], [False, False, False, True, True, False, False]),
        ([0.0, 0.0, -1.1, 0.0, 0.0, 0.0, 0.0], [False] * 6 + [True]),
    ],
    ids=["after the dwell", "not entered", "left at the edge itself", "below"],
)
def test_the_expected_duty_is_that_of_the_window_on_the_true_motion(levels_mm, is_on):
    times_us = np.arange(len(levels_mm)) * FRAME_US
    assert beam_on(times_us, np.array(levels_mm), WINDOW).tolist() == is_on


def session(tmp_path, late=(), error_mm=0.0):
    """A stored session over the whole truth, armed from frame 400 on."""
    np.savez(
        tmp_path / "truth.npz",
        **{name: np.zeros(1) for name in Truth.__dataclass_fields__ if name not in {"timestamp_us", "whole_depth_mm"}},
        timestamp_us=TRUE_US,
        whole_depth_mm=DEPTH_MM,
    )
    with (tmp_path / "samples.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, ["timestamp_us", "whole_mm", "gate", "hold_reason"])
        writer.writeheader()
        for index, (time_us, level) in enumerate(zip(TRUE_US, BREATH_MM, strict=True)):
            reason = "frame_late" if index in late else ""
            gate = "hold" if index >= 400 else "disarmed"
            value = level * (1.0 + error_mm)
            writer.writerow({"timestamp_us": time_us, "whole_mm": value, "gate": gate, "hold_reason": reason})
    duty = float(beam_on(TRUE_US[ARMED].astype(float), BREATH_MM[ARMED], WINDOW).mean())
    summary = {"missed_frames": 0, "lost": 0, "duty_cycle": duty, "latency": {"p99_ms": 5.0}}
    return summary, tmp_path / "samples.csv", tmp_path, WINDOW


def test_a_session_as_the_truth_is_as_expected(tmp_path):
    result = result_of(*session(tmp_path))
    assert [row.what for row in result.rows if not row.is_expected] == []
    assert result.verdict == "Everything is as expected."


def test_a_wrong_motion_is_named(tmp_path):
    result = result_of(*session(tmp_path, error_mm=0.1))
    assert result.verdict == "Not as expected: motion, mean error."


def test_a_frame_that_is_late_now_and_then_is_expected(tmp_path):
    assert result_of(*session(tmp_path, late=[500])).verdict == "Everything is as expected."


def test_a_slow_machine_is_named_as_the_cause(tmp_path):
    result = result_of(*session(tmp_path, late=range(500, 520), error_mm=0.1))
    assert result.verdict.startswith("This machine was too slow: 20 frames were late.")


def test_a_session_that_was_never_armed_says_so(tmp_path):
    _, samples, folder, window = session(tmp_path)
    lines = samples.read_text().splitlines()
    samples.write_text("\n".join(lines[:200]))
    summary = {"missed_frames": 0, "lost": 3, "duty_cycle": None, "latency": {"p99_ms": None}}
    result = result_of(summary, samples, folder, window)
    assert result.verdict == "Not as expected: frames not measurable, armed."
