"""Learned motion models on disk: one file a model, named by the hash of what it holds and what made it."""

import hashlib
from pathlib import Path

import numpy as np

from engine import __version__
from engine.errors import ModelError
from engine.model import MotionModel
from engine.model_file import header_text, load_model, save_model
from engine.provenance import MAX_TEXT, ModelOrigin
from service import schemas
from service.ports import SessionPlan

SOFTWARE = f"tidegate {__version__}"
MODELS_FOLDER = "models"


def origin_of(plan: SessionPlan) -> ModelOrigin:
    """Say where a model learned in this session comes from; the time is added when it is kept."""
    camera = plan.source.uri if isinstance(plan.source, schemas.DeviceSource) else None
    source = camera or "camera" if plan.recording is None else plan.recording.name
    return ModelOrigin(patient=plan.patient_reference, source=source[-MAX_TEXT:], software=SOFTWARE)


class ModelStore:
    """A folder of models."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def save(self, model: MotionModel) -> str:
        """Keep a model; returns the SHA-256 of its content. The same model twice is one file."""
        sha256 = content_sha256(model)
        path = self._path(sha256)
        if not path.exists():
            self._folder.mkdir(parents=True, exist_ok=True)
            save_model(model, path)
        return sha256

    def load(self, sha256: str) -> MotionModel:
        """Read a model back; raise ModelError when the file is not what was kept."""
        model = load_model(self._path(sha256))
        if content_sha256(model) != sha256:
            msg = "the model's file was changed after it was kept"
            raise ModelError(msg)
        return model

    def _path(self, sha256: str) -> Path:
        return self._folder / f"{sha256}.npz"


def content_sha256(model: MotionModel) -> str:
    """Identify a model by everything its file holds: the arrays, and what made them."""
    digest = hashlib.sha256(header_text(model).encode())
    for array in (model.mean_mm, model.components, model.eigenvalues_mm2, model.known, model.surface_mm):
        if array is not None:
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
