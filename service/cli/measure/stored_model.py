"""Stored motion models: read one, and the origin that is stored with a new one."""

from pathlib import Path

from engine import __version__
from engine.core.motion_model import MotionModel
from engine.core.provenance import MAX_TEXT, ModelOrigin, check_patient
from engine.motion.learning.model_file import load_model
from service.cli.terminal import say

SOFTWARE = f"tidegate {__version__}"


def stored_model(path: Path, patient: str | None) -> MotionModel:
    """Read a model and refuse that of another patient; without ``patient``, print that this was not checked."""
    model = load_model(path)
    if patient is None:
        say("Note: it was not checked that this model is this patient's; give --patient to check it", "yellow")
    else:
        check_patient(model.provenance.origin, patient)
    return model


def model_origin(recording: Path, patient: str | None) -> ModelOrigin:
    """Return the origin of a model trained on a recording.

    Without the time of day: on one processor the same recording gives the same file, byte for byte.
    """
    return ModelOrigin(patient=patient or "", source=recording.name[-MAX_TEXT:], software=SOFTWARE)
