"""Motion models on disk: one file per model, named by the hash of its arrays and its provenance."""

import hashlib
from pathlib import Path

import numpy as np

from engine.core.errors import ModelError
from engine.core.motion_model import MotionModel
from engine.motion.learning.model_file import header_text, load_model, save_model

MODELS_FOLDER = "models"


class ModelStore:
    """A folder of models."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def save(self, model: MotionModel) -> str:
        """Store a model; return the SHA-256 of its content. The same model stored twice is one file."""
        sha256 = content_sha256(model)
        path = self._path(sha256)
        if not path.exists():
            self._folder.mkdir(parents=True, exist_ok=True)
            save_model(model, path)
        return sha256

    def load(self, sha256: str) -> MotionModel:
        """Read a model; raise ModelError where the file was changed."""
        model = load_model(self._path(sha256))
        if content_sha256(model) != sha256:
            msg = "the model's file was changed after it was stored"
            raise ModelError(msg)
        return model

    def _path(self, sha256: str) -> Path:
        return self._folder / f"{sha256}.npz"


def content_sha256(model: MotionModel) -> str:
    """Return the SHA-256 of everything in a model's file: header and arrays."""
    digest = hashlib.sha256(header_text(model).encode())
    for array in (model.mean_mm, model.components, model.eigenvalues_mm2, model.known, model.surface_mm):
        if array is not None:
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
