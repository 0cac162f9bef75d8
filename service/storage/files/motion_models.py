"""Motion models on disk: one file per model, named by the hash of its arrays and its provenance.

Where a session's tape and its raw recording are stored: one file each, named after the session.
"""

import hashlib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from engine.core.errors import ModelError
from engine.core.motion_model import MotionModel
from engine.motion import ARRAYS, OPTIONAL_ARRAYS, header_text, load_model, save_model
from engine.offline.replay import SUFFIX

MODELS_FOLDER = "models"
_FIRST_HASHED = ("mean_mm", "components", "eigenvalues_mm2", "known", "surface_mm")
"""Arrays that the hash covered until version 0.2.0."""
TAPES_FOLDER, RAW_FOLDER = "replays", "raw"


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
        """Read a model; raise ModelError where the file was changed.

        Of a file that was named by the hash of its first arrays only, the others are ignored: nothing shows whether
        they were changed.
        """
        model = load_model(self._path(sha256))
        if content_sha256(model) == sha256:
            return model
        if _hash(model, _FIRST_HASHED) == sha256:
            return replace(
                model, scores_mm=None, sample_raw_mm=None, sample_reconstructed_mm=None, residual_map_mm=None
            )
        msg = "the model's file was changed after it was stored"
        raise ModelError(msg)

    def _path(self, sha256: str) -> Path:
        return self._folder / f"{sha256}.npz"


def content_sha256(model: MotionModel) -> str:
    """Return the SHA-256 of everything in a model's file: header and arrays."""
    return _hash(model, (*ARRAYS, *OPTIONAL_ARRAYS))


def _hash(model: MotionModel, names: Iterable[str]) -> str:
    digest = hashlib.sha256(header_text(model).encode())
    for name in names:
        array = getattr(model, name)
        if array is not None:
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def tape_path(data_dir: Path, session_id: str) -> Path:
    """Return the path of a session's tape, whether or not it exists."""
    return data_dir / TAPES_FOLDER / f"{session_id}{SUFFIX}"


def raw_path(data_dir: Path, session_id: str) -> Path:
    """Return the path of a session's raw camera recording; only sites with ``record_raw`` have one."""
    return data_dir / RAW_FOLDER / f"{session_id}.oni"
