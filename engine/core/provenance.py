"""Provenance of a motion model: quality of its training set, settings, source, patient and software.

Plain numbers and texts, below the model, so that a file of it can be judged without the code that learned it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from engine.core.errors import InvalidValueError, ModelMismatchError

MAX_TEXT = 200
MAX_SETTINGS = 64


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
