"""Maps that show a person what a model does with its training frames; nothing is computed from them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from engine.core.frames import FloatArray, Projection, RoiDepth
from engine.core.motion_model import MotionModel
from engine.motion.stages.projection import SAMPLED_SHAPE, STRIDE_PX, Basis


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
