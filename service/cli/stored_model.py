"""Motion models at the command line: read one to measure with, and say where a learned one comes from."""

from pathlib import Path

from engine import __version__
from engine.model import MotionModel
from engine.model_file import load_model
from engine.provenance import MAX_TEXT, ModelOrigin, check_patient
from service.cli.terminal import say

SOFTWARE = f"tidegate {__version__}"


def stored_model(path: Path, patient: str | None) -> MotionModel:
    """Read a model, and refuse it for another patient; without a patient to compare, say that nobody did."""
    model = load_model(path)
    if patient is None:
        say("Mind: whose model this is was not checked; give --patient to have it checked", "yellow")
    else:
        check_patient(model.provenance.origin, patient)
    return model


def model_origin(recording: Path, patient: str | None) -> ModelOrigin:
    """Say where a model learned from a recording comes from.

    Without the time of day: the same recording gives the same file, byte for byte.
    """
    return ModelOrigin(patient=patient or "", source=recording.name[-MAX_TEXT:], software=SOFTWARE)
