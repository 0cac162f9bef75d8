"""The motion model: a patient's mean surface and the few ways it moves (article, sections 4.3.2 and 4.4.1).

Everything is on the region's grid, 350 rows by 200 columns, depth in mm along the depth camera's axis. Equation (3) of
the article prints a frame where the *mean* frame is subtracted; equation (5)'s eigenvectors are n long and have to be
mapped back through the data to become components.

Provenance of a motion model: quality of its training set, settings, source, patient and software.

Plain numbers and texts, below the model, so that a file of it can be judged without the code that learned it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from engine.core.errors import InvalidValueError, ModelError, ModelMismatchError
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, FloatArray, frozen
from engine.core.locking_curve import LockingCurve

MAX_TEXT = 200
MAX_SETTINGS = 64
QUALITY_BOUNDS: Mapping[str, tuple[float, float]] = {
    "amplitude_mm": (0.0, 500.0),
    "noise_mm": (0.0, 500.0),
    "explained_share": (0.0, 1.0),
    "shift_mm": (0.0, 10_000.0),
    "tilt_deg": (0.0, 180.0),
    "outlier_share": (0.0, 1.0),
    "residual_mm": (0.0, 10_000.0),
}
"""Bounds of each figure, for reading it from a file."""
# Of models of the first schema, which did not measure it.
USUAL_NOISE_MM = 5.0
DEPTH_STEPS = 3
"""Numbers that describe the steps of a sensor's readings."""
SAMPLE_SHAPE = (-(-ROI_ROWS // 4), -(-ROI_COLUMNS // 4))
"""Rows and columns of the maps that show a model's quality."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingQuality:
    """What the training frames were worth.

    Attributes
    ----------
    amplitude_mm
        Breathing excursion, 5th to 95th percentile of the largest of whole, thorax and abdomen [mm].
    noise_mm
        Standard deviation of that signal from frame to frame where it does not breathe [mm].
    explained_share
        Share of the variance that the kept components explain, 0 to 1.
    shift_mm, tilt_deg
        How far the patient moved between the first and the last third of the set, breathing averaged out.
    outlier_share
        Share of the frames that the model learned from them does not explain: coughs, speech, a hand.
    residual_mm
        Median over the frames of the largest mean misfit of a cell [mm].
    """

    amplitude_mm: float
    noise_mm: float
    explained_share: float
    shift_mm: float
    tilt_deg: float
    outlier_share: float
    residual_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelOrigin:
    """Where a model comes from; the caller fills it in, since the engine has neither patients nor the time of day.

    Attributes
    ----------
    patient
        The clinic's pseudonym; empty where none was given.
    source
        Name of the recording, or of the camera.
    created_at
        RFC 3339 UTC; empty where a model has to come out the same from the same recording.
    """

    patient: str = ""
    source: str = ""
    created_at: str = ""
    software: str = ""

    def __post_init__(self) -> None:
        """Refuse texts that no file should hold."""
        for name in ("patient", "source", "created_at", "software"):
            check_text(name, getattr(self, name))


@dataclass(frozen=True, slots=True, kw_only=True)
class Provenance:
    """Figures and settings of the training, and the origin once it is known."""

    quality: TrainingQuality | None = None
    settings: Mapping[str, float] = field(default_factory=dict)
    origin: ModelOrigin | None = None


def check_patient(origin: ModelOrigin | None, patient: str) -> None:
    """Raise for a model of another or an unknown patient; the message does not contain the other pseudonym."""
    if origin is None or not origin.patient:
        raise ModelMismatchError("model.patient", "not known", f"{patient}: learn a new model")
    if origin.patient != patient:
        raise ModelMismatchError("model.patient", "another patient", f"{patient}: learn a new model")


def check_text(name: str, value: object) -> str:
    """Take a printable text of at most 200 characters, which may be empty."""
    if not isinstance(value, str) or len(value) > MAX_TEXT or not (value.isprintable() or not value):
        raise InvalidValueError(name, value, f"at most {MAX_TEXT} printable characters")
    return value


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionModel:
    """Mean surface, principal components and spectrum of one patient's breathing.

    Attributes
    ----------
    mean_mm
        Mean depth [mm], shape (350, 200), float32; filled in smoothly where ``known`` is false.
    components
        Orthonormal over the grid, shape (k, 350, 200), float32. Sign: a growing first coefficient is inhale, so each
        component's mean is negative; a retrained model does not flip.
    eigenvalues_mm2
        Variance of each principal component, descending [mm^2, summed over the grid], shape (n,).
    known
        Where at least half of the training frames had a reading, shape (350, 200).
    cycles
        Complete breathing cycles among the training frames.
    calibration_sha256
        The calibration the frames were aligned with.
    noise_mm
        The sensor's noise: the mean of a square of side n grid pixels varies by this over n, its correlation included.
    surface_mm
        Mean of the surface's vertices at the region's nodes, in the depth camera's frame [mm], shape (nodes, 3), NaN
        where none was visible; None in models without it. A later fraction compares the patient's position with it.
    scores_mm
        First coefficients, of the components, of some of the training frames [mm], shape (frames, k): the range the
        patient breathed over. None in models without them.
    sample_raw_mm, sample_reconstructed_mm
        The training frame with the deepest breath among those that the quality was taken from, as the camera measured
        it (NaN where it measured nothing) and as the model reconstructs it [mm], on every fourth row and column, shape
        (88, 50); None in models without them. They are for people: nothing is computed from them.
    residual_map_mm
        Root mean square of the difference of the two over those frames [mm], shape (88, 50), NaN where there is none.
    depth_steps
        The steps of the sensor's readings in the training: offset and step of the inverse depth [1/mm], and rounding
        [mm]; empty for a sensor without steps, None in models without them.
    locking
        The sensor's error that is common to all pixels, which the training found; None where there is none.
    shape_errors
        What is left of each component's error, root mean square over the points [mm for a coefficient of 1 mm], k of
        them; None in models without them.
    provenance
        How good the training was, and where the model comes from.
    """

    mean_mm: FloatArray
    components: FloatArray
    eigenvalues_mm2: FloatArray
    known: BoolArray
    training_frames: int
    cycles: int
    seconds: float
    calibration_sha256: str
    noise_mm: float = USUAL_NOISE_MM
    surface_mm: FloatArray | None = None
    scores_mm: FloatArray | None = None
    sample_raw_mm: FloatArray | None = None
    sample_reconstructed_mm: FloatArray | None = None
    residual_map_mm: FloatArray | None = None
    depth_steps: tuple[float, ...] | None = None
    locking: LockingCurve | None = None
    shape_errors: tuple[float, ...] | None = None
    provenance: Provenance = field(default_factory=Provenance)

    def __post_init__(self) -> None:
        """Raise ModelError for wrong shapes or values that are not finite."""
        grid = (ROI_ROWS, ROI_COLUMNS)
        if self.mean_mm.shape != grid or self.known.shape != grid or self.components.shape[1:] != grid:
            msg = f"a model lives on the {ROI_ROWS} x {ROI_COLUMNS} grid, not {self.mean_mm.shape}"
            raise ModelError(msg)
        if not (np.isfinite(self.mean_mm).all() and np.isfinite(self.components).all()):
            msg = "a model must be finite everywhere"
            raise ModelError(msg)
        surface = self.surface_mm
        if surface is not None and (surface.shape[1:] != (3,) or np.isinf(surface).any()):
            msg = f"a model's surface is made of points, not {surface.shape}, and none is infinitely far"
            raise ModelError(msg)
        scores = self.scores_mm
        if scores is not None and (scores.shape[1:] != (len(self.components),) or not np.isfinite(scores).all()):
            msg = f"a model's scores are one number a component, all finite, not {scores.shape}"
            raise ModelError(msg)
        self._check_numbers()
        maps = self._checked_maps()
        arrays = (self.mean_mm, self.components, self.eigenvalues_mm2, self.known, self.surface_mm, self.scores_mm)
        for array in (*arrays, *maps):
            if array is not None:
                frozen(array)

    def _check_numbers(self) -> None:
        errors, steps = self.shape_errors, self.depth_steps
        if errors is not None and len(errors) != len(self.components):
            msg = f"a model has one error a component, not {len(errors)}"
            raise ModelError(msg)
        if steps is not None and len(steps) not in {0, DEPTH_STEPS}:
            msg = f"a model's depth steps are {DEPTH_STEPS} numbers or none, not {len(steps)}"
            raise ModelError(msg)

    def zero_error_mm(self, coefficients: FloatArray) -> float:
        """Return the standard uncertainty of a reference at these coefficients, shape (k,) or longer [mm].

        The reference lies so far from the middle of the training, and each component errs by its share of that way:
        the motion of a point is wrong by as much in every frame. NaN for a model without its components' errors.
        """
        if self.shape_errors is None:
            return float("nan")
        k = len(self.components)
        noise_mm = self.noise_mm * np.sqrt(k / self.mean_mm.size)
        return float(np.hypot(np.linalg.norm(coefficients[:k] * np.array(self.shape_errors)), noise_mm))

    def _checked_maps(self) -> tuple[FloatArray | None, ...]:
        maps = (self.sample_raw_mm, self.sample_reconstructed_mm, self.residual_map_mm)
        if any(one is not None and (one.shape != SAMPLE_SHAPE or np.isinf(one).any()) for one in maps):
            msg = f"a model's maps have the shape {SAMPLE_SHAPE}, and nothing in them is infinite"
            raise ModelError(msg)
        return maps

    def from_origin(self, origin: ModelOrigin) -> "MotionModel":
        """Return the model with this origin; an origin that it already has is kept."""
        if self.provenance.origin is not None:
            return self
        return replace(self, provenance=replace(self.provenance, origin=origin))

    @property
    def spectrum(self) -> FloatArray:
        """Share of the variance each principal component explains, descending, sums to 1 (article, Fig. 5)."""
        total = float(self.eigenvalues_mm2.sum())
        return self.eigenvalues_mm2 / total if total > 0.0 else np.zeros_like(self.eigenvalues_mm2)

    def reconstruct(self, beta: FloatArray) -> FloatArray:
        """Equation (7): the surface that coefficients mean [mm], shape (350, 200)."""
        return self.mean_mm + np.tensordot(beta, self.components, axes=1)
