"""Result of a demonstration: what the service stored, beside what the phantom's truth and the marks lead to expect."""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.signal import find_peaks

from engine.core.frames import BoolArray, FloatArray
from lab.evaluation.runs.marks import LIVE_MM
from lab.phantom.truth import load_truth

PROMINENCE_SHARE = 0.4
"""Smallest rise of a breath, of the 5 to 95 % range of the trace."""
LATE_SHARE = 0.01
"""Largest expected share of late frames: the program compiles at its first start, and a browser may draw the page."""
LATE = frozenset({"frame_late", "frame_missing", "frame_rate_low", "frame_stale", "frame_timeout", "latency_high"})
"""Reasons of holds that a machine gives which is too slow for 30 frames a second."""
REFERENCE_MM = 0.5
"""Longest expected distance of the reference from the true end of exhale: it is the mean of the breaths before."""
DUTY_SHARE = 0.05
"""Expected difference of the duty cycle from that of the true motion."""
LATENCY_MS = 100.0
"""Longest latency that AAPM TG-142 allows a gating system."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoWindow:
    """The amplitude window of the demonstration: edges and hysteresis [mm], dwell [s]."""

    lower_mm: float
    upper_mm: float
    hysteresis_mm: float
    dwell_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Motion of the whole region against the truth [mm].

    Attributes
    ----------
    reference_mm
        The true end of exhale as measured, mean over the breaths: 0 where the reference lies there.
    errors_mm
        Measured minus true motion of each frame, each from its own mean, shape (n,): independent of the reference.
    level_mm
        The true motion of each frame against the true end of exhale, shape (n,).
    """

    reference_mm: float
    errors_mm: FloatArray
    level_mm: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One row of the result: what is expected and what was measured, as words, and whether they agree."""

    what: str
    expected: str
    measured: str
    is_expected: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """The rows, and the number of frames that were lost, late or decided too late."""

    rows: tuple[Row, ...]
    late: int

    @property
    def verdict(self) -> str:
        """One sentence for the end of the demonstration."""
        if all(row.is_expected for row in self.rows):
            return "Everything is as expected."
        if self.late:
            return (
                f"This machine was too slow: {self.late} frames were late. Close what else runs on it, and try again."
            )
        wrong = ", ".join(row.what for row in self.rows if not row.is_expected)
        return f"Not as expected: {wrong}."


def result_of(summary: Mapping[str, Any], samples: Path, recording: Path, window: DemoWindow) -> Result:
    """Compare a session's summary and its exported CSV file with a recording's truth."""
    truth = load_truth(recording / "truth.npz")
    with samples.open(newline="") as file:
        rows = list(csv.DictReader(file))
    late = summary["missed_frames"] + sum(row["hold_reason"] in LATE for row in rows)
    armed = [row for row in rows if row["gate"] != "disarmed" and row["whole_mm"]]
    found = [
        _count("frames lost or late", late, most=int(LATE_SHARE * len(rows))),
        _count("frames not measurable", summary["lost"], most=0),
    ]
    compared = None
    if armed:
        times_us = np.array([int(row["timestamp_us"]) for row in armed], dtype=np.float64)
        motion_mm = np.array([float(row["whole_mm"]) for row in armed])
        compared = compare(times_us, motion_mm, truth.timestamp_us, truth.whole_depth_mm)
    if compared is None:
        found.append(Row(what="armed", expected="for a breath or more", measured="no", is_expected=False))
        return Result(rows=tuple(found), late=late)
    return Result(rows=(*found, *_compared(compared, times_us, summary, window)), late=late)


def _count(what: str, count: int, *, most: int) -> Row:
    return Row(what=what, expected=f"at most {most}" if most else "0", measured=str(count), is_expected=count <= most)


def _compared(found: Comparison, times_us: FloatArray, summary: Mapping[str, Any], window: DemoWindow) -> list[Row]:
    errors_mm = np.abs(found.errors_mm)
    true_duty = float(beam_on(times_us, found.level_mm, window).mean())
    duty = summary["duty_cycle"] or 0.0
    p99_ms = summary["latency"]["p99_ms"] or 0.0
    return [
        Row(
            what="reference, from the true end of exhale",
            expected=f"within {REFERENCE_MM:g} mm",
            measured=f"{found.reference_mm:+.2f} mm",
            is_expected=abs(found.reference_mm) <= REFERENCE_MM,
        ),
        Row(
            what="motion, mean error",
            expected=f"at most {LIVE_MM:g} mm",
            measured=f"{errors_mm.mean():.3f} mm (worst frame {errors_mm.max():.2f})",
            is_expected=float(errors_mm.mean()) <= LIVE_MM,
        ),
        Row(
            what="beam on, of the armed time",
            expected=f"{true_duty:.0%}, by the true motion",
            measured=f"{duty:.0%}",
            is_expected=abs(duty - true_duty) <= DUTY_SHARE,
        ),
        Row(
            what="latency, camera to beam line, 99 %",
            expected=f"below {LATENCY_MS:g} ms",
            measured=f"{p99_ms:.1f} ms",
            is_expected=p99_ms < LATENCY_MS,
        ),
    ]


def beam_on(times_us: FloatArray, level_mm: FloatArray, window: DemoWindow) -> BoolArray:
    """Return at which frames an amplitude window has the beam on: entered by its hysteresis, and for its dwell."""
    is_on = np.zeros(len(times_us), dtype=bool)
    since_us: float | None = None
    for index, (time_us, level) in enumerate(zip(times_us, level_mm, strict=True)):
        margin = window.hysteresis_mm if since_us is None else 0.0
        if not window.lower_mm + margin <= level <= window.upper_mm - margin:
            since_us = None
            continue
        since_us = time_us if since_us is None else since_us
        is_on[index] = time_us - since_us >= window.dwell_s * 1e6
    return is_on


def compare(
    times_us: FloatArray, motion_mm: FloatArray, true_us: npt.NDArray[np.int64], depth_mm: FloatArray
) -> Comparison | None:
    """Compare motion with the true depth, both by time; None unless the motion covers an end of exhale.

    Parameters
    ----------
    times_us, motion_mm
        Measured frames [us, mm], inhale positive, shape (n,).
    true_us, depth_mm
        The true depth of the region [us, mm], shape (m,).
    """
    prominence = PROMINENCE_SHARE * float(np.ptp(np.percentile(depth_mm, [5.0, 95.0])))
    exhales, _ = find_peaks(depth_mm, prominence=prominence)
    exhales = exhales[(true_us[exhales] >= times_us[0]) & (true_us[exhales] <= times_us[-1])]
    if not exhales.size:
        return None
    true_mm = -np.interp(times_us, true_us, depth_mm)
    difference_mm = motion_mm - true_mm
    mean_mm = float(difference_mm.mean())
    exhale_mm = float(depth_mm[exhales].mean())
    return Comparison(reference_mm=mean_mm - exhale_mm, errors_mm=difference_mm - mean_mm, level_mm=true_mm + exhale_mm)
