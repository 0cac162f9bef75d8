"""Accuracy of a demonstration: the stored motion against the phantom's truth, from the confirmed reference on."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.signal import find_peaks

from engine.core.frames import FloatArray
from engine.lab.phantom.truth import load_truth

PROMINENCE_SHARE = 0.4
"""Smallest rise of a breath, of the 5 to 95 % range of the trace."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """Errors of the whole-region motion against the truth [mm].

    Attributes
    ----------
    reference_mm
        The true end of exhale as measured, mean over the breaths: 0 where the reference lies there.
    errors_mm
        Measured minus true motion of each frame, each from its own mean, shape (n,): independent of the reference.
    """

    reference_mm: float
    errors_mm: FloatArray


def accuracy_of(samples: Path, recording: Path) -> Accuracy | None:
    """Compare the armed frames of an exported CSV file with a recording's truth; None without an end of exhale."""
    truth = load_truth(recording / "truth.npz")
    with samples.open(newline="") as file:
        armed = [row for row in csv.DictReader(file) if row["gate"] != "disarmed" and row["whole_mm"]]
    if not armed:
        return None
    times_us = np.array([int(row["timestamp_us"]) for row in armed], dtype=np.float64)
    motion_mm = np.array([float(row["whole_mm"]) for row in armed])
    return compare(times_us, motion_mm, truth.timestamp_us, truth.whole_depth_mm)


def compare(
    times_us: FloatArray, motion_mm: FloatArray, true_us: npt.NDArray[np.int64], depth_mm: FloatArray
) -> Accuracy | None:
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
    return Accuracy(reference_mm=mean_mm - float(depth_mm[exhales].mean()), errors_mm=difference_mm - mean_mm)
