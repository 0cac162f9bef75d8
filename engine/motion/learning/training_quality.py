"""Quality checks of a training set: breathing amplitude against noise, patient movement, coughs and occlusions.

A refusal names the figure, its bound, and what the operator can do.

Maps that show a person what a model does with its training frames; nothing is computed from them.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from engine.core.errors import TrainingRefusedError
from engine.core.frames import BoolArray, FloatArray, Projection, RoiDepth
from engine.core.motion_model import MotionModel
from engine.motion.breathing import excursion_mm, noise_mm, speed_mm_s
from engine.motion.learning.position_fit import rigid_between
from engine.motion.learning.trainer import TrainingSettings
from engine.motion.learning.training_set import Signals, TrainingFrame, Vertices, evenly, mean_surface
from engine.motion.stages.projection import SAMPLED_SHAPE, STRIDE_PX, Basis

NOISE_FACTOR = 4.0
"""Least ratio of amplitude to noise of a breathing signal."""

COUGH_MM_S = 80.0
"""Speed of a cough: ten times that of a breath of 10 mm in 4 s; a deep breath of 40 mm stays below half of it."""

BREATH_LEFT = 0.6
"""Share of a breath's excursion by which the means of two thirds of a set may differ, as they hold no whole breaths."""

HAND_MM = 40.0
HAND_SHARE = 0.02
COARSE_STEP_PX = 10
SURFACE_FRAMES = 40


def refuse_breathless(signals: Signals, settings: TrainingSettings) -> tuple[float, float]:
    """Return amplitude and noise [mm]; raise TrainingRefusedError if the amplitude is too small."""
    signal = signals.largest
    amplitude, noise = excursion_mm(signal, signals.seconds), noise_mm(signal)
    least = max(settings.min_amplitude_mm, NOISE_FACTOR * noise)
    if not amplitude >= least:
        raise TrainingRefusedError(
            "training.amplitude_mm",
            f"{amplitude:.2f}",
            f"at least {least:.2f}",
            "no breathing was measured: check that the markers are on the patient's chest and abdomen, and that the "
            "patient breathes freely",
        )
    return amplitude, noise


def refuse_moving(
    frames: Sequence[TrainingFrame], vertices: Vertices, settings: TrainingSettings, amplitude_mm: float
) -> tuple[float, float]:
    """Return shift [mm] and tilt [deg] between the first and the last third; raise TrainingRefusedError if too large.

    A third holds about one breath, seldom a whole one; the possible remainder of a breath towards the camera is
    subtracted.
    """
    third = max(len(frames) // 3, 1)
    first, last = evenly(frames[:third], SURFACE_FRAMES), evenly(frames[-third:], SURFACE_FRAMES)
    moved = rigid_between(mean_surface(first, vertices), mean_surface(last, vertices))
    if moved is None:
        raise TrainingRefusedError(
            "training.seen", "too little of the region", "visible throughout", "clear the view of the camera"
        )
    x_mm, y_mm, z_mm = moved.shift_mm
    shift_mm = math.hypot(x_mm, y_mm, max(abs(z_mm) - BREATH_LEFT * amplitude_mm, 0.0))
    advice = "the patient or the couch has moved: train again while the patient lies still"
    for name, value, most in (
        ("shift_mm", shift_mm, settings.max_shift_mm),
        ("tilt_deg", moved.tilt_deg, settings.max_tilt_deg),
    ):
        if not value <= most:
            raise TrainingRefusedError(f"training.{name}", f"{value:.1f}", f"at most {most:g}", advice)
    return shift_mm, moved.tilt_deg


def find_outliers(frames: Sequence[TrainingFrame], signals: Signals, amplitude_mm: float) -> BoolArray:
    """Frames with a cough or an occlusion, shape (frames,)."""
    speeds = np.max([speed_mm_s(signal, signals.seconds) for signal in signals.motion_mm.T], axis=0)
    is_fast = speeds[signals.kept] > COUGH_MM_S
    depth, valid = _coarse(frames)
    middle = np.median(np.where(valid, depth, np.median(depth[valid])), axis=0) if valid.any() else depth[0]
    far_mm = max(HAND_MM, 2.0 * amplitude_mm)
    is_far = (np.abs(depth - middle) > far_mm) & valid
    is_covered = is_far.sum(axis=(1, 2)) > HAND_SHARE * np.maximum(valid.sum(axis=(1, 2)), 1)
    return np.asarray(is_fast | is_covered)


def refuse_disturbed(outliers: BoolArray, settings: TrainingSettings) -> float:
    """Return the share of outliers, 0 to 1; raise TrainingRefusedError if it is too large."""
    share = float(outliers.mean())
    if not share <= settings.max_outlier_share:
        raise TrainingRefusedError(
            "training.outlier_share",
            f"{share:.2f}",
            f"at most {settings.max_outlier_share:g}",
            "the patient coughed or an object was in view: train again",
        )
    return share


def _coarse(frames: Sequence[TrainingFrame]) -> tuple[FloatArray, BoolArray]:
    rois = [frame.roi for frame in frames]
    step = slice(None, None, max(COARSE_STEP_PX // rois[0].stride_px, 1))
    return np.stack([roi.depth_mm[step, step] for roi in rois]), np.stack([roi.valid[step, step] for roi in rois])


def with_quality_maps(
    model: MotionModel, basis: Basis, explained: Sequence[tuple[RoiDepth, Projection]]
) -> MotionModel:
    """Return the model with its deepest breath, measured and reconstructed, and with the map of its residuals.

    The frames are not empty; ``basis`` is of this model. See `MotionModel` for shapes and units.
    """
    thinned = [(roi.thinned(STRIDE_PX), outcome.coefficients) for roi, outcome in explained]
    components = model.components[:, ::STRIDE_PX, ::STRIDE_PX]

    def reconstructed(coefficients: FloatArray) -> FloatArray:
        """Return the whole surface, also where the basis has no component because the training saw nothing."""
        beta, smooth = coefficients[: len(components)], coefficients[len(components) :]
        grid = smooth.reshape(basis.cosine_rows.shape[1], basis.cosine_columns.shape[1])
        motion_mm = np.tensordot(beta, components, axes=1) + basis.cosine_rows @ grid @ basis.cosine_columns.T
        return np.asarray(model.mean_mm[::STRIDE_PX, ::STRIDE_PX] + motion_mm)

    squares = np.zeros(SAMPLED_SHAPE)
    counts = np.zeros(SAMPLED_SHAPE, dtype=np.int64)
    for roi, coefficients in thinned:
        misfit_mm = roi.depth_mm - reconstructed(coefficients)
        squares += np.where(roi.valid, misfit_mm, 0.0) ** 2
        counts += roi.valid
    counts *= basis.sampled_known.reshape(SAMPLED_SHAPE)
    residual_mm = np.sqrt(squares / np.maximum(counts, 1))
    deepest, coefficients = max(thinned, key=lambda one: float(one[1][0]))  # growing is inhale
    return replace(
        model,
        sample_raw_mm=np.where(deepest.valid, deepest.depth_mm, np.nan).astype(np.float32),
        sample_reconstructed_mm=reconstructed(coefficients).astype(np.float32),
        residual_map_mm=np.where(counts > 0, residual_mm, np.nan).astype(np.float32),
    )
