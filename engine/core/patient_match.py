"""How far the patient of today is from a stored model, as a value."""

from dataclasses import dataclass

import numpy as np

from engine.core.errors import ModelMismatchError


@dataclass(frozen=True, slots=True, kw_only=True)
class PatientMatch:
    """How far the patient of today is from a stored model.

    Attributes
    ----------
    residual_mm
        Median over the explained frames of the largest mean misfit of a cell [mm]; None where none was explained.
    explained_share
        Share of the frames that the model explains, 0 to 1.
    shift_mm
        From the training to today, in the depth camera's frame (x, y, z) [mm]; z is away from the camera.
    tilt_deg
        Rotation about the region's centre [deg].
    shape_mm
        Root mean square difference of the surfaces that shift and tilt do not explain [mm].
    refusal
        Why the model is not to be used on this patient; None when it may.
    """

    frames: int
    explained_share: float
    residual_mm: float | None
    shift_mm: tuple[float, float, float]
    tilt_deg: float
    shape_mm: float
    refusal: ModelMismatchError | None = None

    @property
    def distance_mm(self) -> float:
        """Length of the shift [mm]."""
        return float(np.linalg.norm(self.shift_mm))
