"""Whether a training set teaches anything: breath against noise, a patient who stays, frames without coughs or hands.

What is refused is refused with the figure, its bound, and what to do about it.
"""

import math
from collections.abc import Sequence

import numpy as np

from engine.errors import TrainingRefusedError
from engine.frames import BoolArray, FloatArray
from engine.gathering import GatheredFrame, Signals, Vertices, evenly, mean_surface
from engine.rigid import rigid_between
from engine.stages.breathing import excursion_mm, noise_mm, speed_mm_s
from engine.training import TrainingSettings

NOISE_FACTOR = 4.0
"""A signal that is no deeper than this times its noise is taken for noise."""

COUGH_MM_S = 80.0
"""Ten times as fast as 10 mm of breath in 4 s; 40 mm of deep breath stay below a half of it."""

BREATH_LEFT = 0.6
"""Of a breath's excursion: how far the means of two thirds of a set may differ for want of whole breaths."""

HAND_MM = 40.0
HAND_SHARE = 0.02
COARSE_STEP_PX = 10
SURFACE_FRAMES = 40


def refuse_breathless(signals: Signals, settings: TrainingSettings) -> tuple[float, float]:
    """Return amplitude and noise [mm], or raise TrainingRefusedError where nothing breathes."""
    signal = signals.largest
    amplitude, noise = excursion_mm(signal, signals.seconds), noise_mm(signal)
    least = max(settings.min_amplitude_mm, NOISE_FACTOR * noise)
    if not amplitude >= least:
        raise TrainingRefusedError(
            "training.amplitude_mm",
            f"{amplitude:.2f}",
            f"at least {least:.2f}",
            "nothing breathes: see that the markers lie on the patient's chest and abdomen, and that the patient "
            "breathes freely",
        )
    return amplitude, noise


def refuse_moving(
    frames: Sequence[GatheredFrame], vertices: Vertices, settings: TrainingSettings, amplitude_mm: float
) -> tuple[float, float]:
    """Return shift [mm] and tilt [deg] between the first and the last third, or raise TrainingRefusedError.

    A third is about a breath and seldom a whole one: towards the camera, what that may leave of it is no shift.
    """
    third = max(len(frames) // 3, 1)
    first, last = evenly(frames[:third], SURFACE_FRAMES), evenly(frames[-third:], SURFACE_FRAMES)
    moved = rigid_between(mean_surface(first, vertices), mean_surface(last, vertices))
    if moved is None:
        raise TrainingRefusedError(
            "training.seen", "too little of the region", "seen throughout", "clear the view of the camera"
        )
    x_mm, y_mm, z_mm = moved.shift_mm
    shift_mm = math.hypot(x_mm, y_mm, max(abs(z_mm) - BREATH_LEFT * amplitude_mm, 0.0))
    advice = "the patient or the couch has moved: learn again while the patient lies still"
    for name, value, most in (
        ("shift_mm", shift_mm, settings.max_shift_mm),
        ("tilt_deg", moved.tilt_deg, settings.max_tilt_deg),
    ):
        if not value <= most:
            raise TrainingRefusedError(f"training.{name}", f"{value:.1f}", f"at most {most:g}", advice)
    return shift_mm, moved.tilt_deg


def find_outliers(frames: Sequence[GatheredFrame], signals: Signals, amplitude_mm: float) -> BoolArray:
    """Which frames show a cough or something in the view, shape (frames,)."""
    speeds = np.max([speed_mm_s(signal, signals.seconds) for signal in signals.motion_mm.T], axis=0)
    is_fast = speeds[signals.kept] > COUGH_MM_S
    depth, valid = _coarse(frames)
    middle = np.median(np.where(valid, depth, np.median(depth[valid])), axis=0) if valid.any() else depth[0]
    far_mm = max(HAND_MM, 2.0 * amplitude_mm)
    far = (np.abs(depth - middle) > far_mm) & valid
    is_covered = far.sum(axis=(1, 2)) > HAND_SHARE * np.maximum(valid.sum(axis=(1, 2)), 1)
    return np.asarray(is_fast | is_covered)


def refuse_disturbed(outliers: BoolArray, settings: TrainingSettings) -> float:
    """Return the share of outliers, or raise TrainingRefusedError where there are too many."""
    share = float(outliers.mean())
    if not share <= settings.max_outlier_share:
        raise TrainingRefusedError(
            "training.outlier_share",
            f"{share:.2f}",
            f"at most {settings.max_outlier_share:g}",
            "the patient coughed or something came into the view: learn again in quiet",
        )
    return share


def _coarse(frames: Sequence[GatheredFrame]) -> tuple[FloatArray, BoolArray]:
    rois = [frame.roi for frame in frames]
    step = slice(None, None, max(COARSE_STEP_PX // rois[0].stride_px, 1))
    return np.stack([roi.depth_mm[step, step] for roi in rois]), np.stack([roi.valid[step, step] for roi in rois])
