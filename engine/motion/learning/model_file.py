"""Motion model files: ``.npz`` with one JSON header, schema ``tidegate.model/2``.

A file is untrusted input: its size is checked before it is unpacked, and every key, number, array type and shape is
validated. Files are written atomically, and the same model gives the same bytes.
"""

import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from engine.core.errors import InvalidValueError, ModelError
from engine.core.files import open_plain, whole_file
from engine.core.frames import FloatArray
from engine.core.locking_curve import HARMONICS, LARGEST_PX, LockingCurve
from engine.core.motion_model import (
    DEPTH_STEPS,
    MAX_SETTINGS,
    QUALITY_BOUNDS,
    ModelOrigin,
    MotionModel,
    Provenance,
    TrainingQuality,
    check_text,
)
from engine.core.strict_json import ROOT, StrictJson

SCHEMA = "tidegate.model/2"
MAX_MODEL_BYTES = 64 * 1024 * 1024
MAX_COMPONENTS = 64
MAX_EIGENVALUES = 10_000
DEPTH_BOUNDS_MM = (100.0, 20_000.0)
PIXELS_BOUNDS_MM = (1_000.0, 1_000_000.0)
NOISE_BOUNDS_MM = (0.01, 1000.0)
HEADER = "header"
ARRAYS: Mapping[str, type[np.generic]] = {
    "mean_mm": np.float32,
    "components": np.float32,
    "eigenvalues_mm2": np.float64,
    "known": np.bool_,
}
OPTIONAL_ARRAYS: Mapping[str, type[np.generic]] = {
    "surface_mm": np.float64,
    "scores_mm": np.float32,
    "sample_raw_mm": np.float32,
    "sample_reconstructed_mm": np.float32,
    "residual_map_mm": np.float32,
}
UNREADABLE = (
    InvalidValueError,
    OSError,
    KeyError,
    ValueError,
    TypeError,
    EOFError,
    MemoryError,
    NotImplementedError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)
"""Exceptions of numpy and zipfile for files that are no archive, or a damaged or malicious one."""
_REQUIRED = (
    *("schema", "training_frames", "cycles", "seconds", "calibration_sha256"),
    *("noise_mm", "quality", "settings", "origin"),
)
_JSON = StrictJson()


def save_model(model: MotionModel, path: str | Path) -> None:
    """Write a model atomically."""
    arrays = {name: getattr(model, name) for name in ARRAYS}
    arrays |= {name: getattr(model, name) for name in OPTIONAL_ARRAYS if getattr(model, name) is not None}
    header = np.frombuffer(header_text(model).encode(), dtype=np.uint8)
    with whole_file(Path(path), is_durable=True) as file:
        np.savez_compressed(file, allow_pickle=False, header=header, **arrays)


def load_model(path: str | Path) -> MotionModel:
    """Read a model; raise ModelError naming the fault if the file is invalid."""
    path = Path(path)
    try:
        arrays = _arrays(path)
        return _model(_JSON.parse(arrays.pop(HEADER).tobytes()), arrays)
    except ModelError as error:
        msg = f"{path.name} is no motion model: {error}"
        raise ModelError(msg) from error
    except UNREADABLE as error:
        msg = f"{path.name} is no motion model: {str(error).splitlines()[0] if str(error) else type(error).__name__}"
        raise ModelError(msg) from error


def header_text(model: MotionModel) -> str:
    """Return all fields of a model that are not arrays, as canonical JSON, which is stored and hashed."""
    provenance = model.provenance
    header = {
        "schema": SCHEMA,
        "training_frames": model.training_frames,
        "cycles": model.cycles,
        "seconds": model.seconds,
        "calibration_sha256": model.calibration_sha256,
        "noise_mm": model.noise_mm,
        "quality": None if provenance.quality is None else asdict(provenance.quality),
        "settings": {name: float(value) for name, value in provenance.settings.items()},
        "origin": None if provenance.origin is None else asdict(provenance.origin),
    }
    if model.depth_steps is not None:
        header["depth_steps"] = list(model.depth_steps)
    if model.locking is not None:
        header["locking"] = asdict(model.locking)
    if model.shape_errors is not None:
        header["shape_errors"] = list(model.shape_errors)
    return json.dumps(header, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    with open_plain(path) as file, zipfile.ZipFile(file) as archive:
        if sum(item.file_size for item in archive.infolist()) > MAX_MODEL_BYTES:
            msg = f"it unpacks to more than {MAX_MODEL_BYTES} bytes"
            raise ModelError(msg)
    wanted: dict[str, type[np.generic]] = {HEADER: np.uint8, **ARRAYS}
    with np.load(path, allow_pickle=False) as archive:
        for name in archive.files:
            if name not in wanted and name not in OPTIONAL_ARRAYS:
                raise InvalidValueError(name, "unknown", f"one of {', '.join([*wanted, *OPTIONAL_ARRAYS])}")
        for name in wanted:
            if name not in archive.files:
                raise InvalidValueError(name, "missing", "given")
        return {name: _typed(name, archive[name], {**wanted, **OPTIONAL_ARRAYS}[name]) for name in archive.files}


def _typed(name: str, array: npt.NDArray[Any], dtype: type[np.generic]) -> npt.NDArray[Any]:
    if array.dtype != dtype:
        raise InvalidValueError(name, array.dtype.name, f"of type {np.dtype(dtype).name}")
    return array


def _model(document: object, arrays: dict[str, npt.NDArray[Any]]) -> MotionModel:
    if isinstance(document, dict) and document.get("schema") != SCHEMA:
        raise InvalidValueError("schema", document.get("schema"), SCHEMA)
    header = _JSON.fields(ROOT, document, required=_REQUIRED, optional=("depth_steps", "locking", "shape_errors"))
    components, eigenvalues = arrays["components"], arrays["eigenvalues_mm2"]
    if components.ndim != 3 or not 1 <= len(components) <= MAX_COMPONENTS:
        raise InvalidValueError("components", components.shape, f"1 to {MAX_COMPONENTS} surfaces")
    if eigenvalues.ndim != 1 or not 1 <= len(eigenvalues) <= MAX_EIGENVALUES or not _lie_in(eigenvalues, 0.0, 1e12):
        raise InvalidValueError("eigenvalues_mm2", eigenvalues.shape, f"1 to {MAX_EIGENVALUES} numbers from 0 up")
    if not _lie_in(arrays["mean_mm"], *DEPTH_BOUNDS_MM):
        bound = f"depths from {DEPTH_BOUNDS_MM[0]:g} to {DEPTH_BOUNDS_MM[1]:g} mm"
        raise InvalidValueError("mean_mm", arrays["mean_mm"].shape, bound)
    return MotionModel(
        **arrays,
        training_frames=_JSON.integer("training_frames", header["training_frames"], 1, 1_000_000),
        cycles=_JSON.integer("cycles", header["cycles"], 0, 10_000),
        seconds=_JSON.number("seconds", header["seconds"], 0.0, 100_000.0),
        calibration_sha256=_sha256("calibration_sha256", header["calibration_sha256"]),
        noise_mm=_JSON.number("noise_mm", header["noise_mm"], *NOISE_BOUNDS_MM),
        depth_steps=_depth_steps(header["depth_steps"]) if "depth_steps" in header else None,
        locking=_locking(header["locking"]) if "locking" in header else None,
        shape_errors=_shape_errors(header["shape_errors"], len(components)) if "shape_errors" in header else None,
        provenance=_provenance(header),
    )


def _locking(document: object) -> LockingCurve:
    found = _JSON.fields("locking", document, required=("pixels_mm", "cosine_px", "sine_px"))
    cosine_px, sine_px = (
        tuple(_JSON.vector(f"locking.{name}", found[name], HARMONICS, -LARGEST_PX, LARGEST_PX))
        for name in ("cosine_px", "sine_px")
    )
    pixels_mm = _JSON.number("locking.pixels_mm", found["pixels_mm"], *PIXELS_BOUNDS_MM)
    return LockingCurve(pixels_mm=pixels_mm, cosine_px=cosine_px, sine_px=sine_px)


def _shape_errors(value: object, components: int) -> tuple[float, ...]:
    return tuple(_JSON.vector("shape_errors", value, components, 0.0, 1.0))


def _depth_steps(value: object) -> tuple[float, ...]:
    if value == []:
        return ()
    offset, step, rounding = _JSON.vector("depth_steps", value, DEPTH_STEPS, -1.0, 1.0)
    return (
        _JSON.number("depth_steps[0]", offset, -1e-3, 1e-3),
        _JSON.number("depth_steps[1]", step, 1e-8, 1e-4),
        _JSON.number("depth_steps[2]", rounding, 0.0, 1.0),
    )


def _provenance(header: Mapping[str, object]) -> Provenance:
    quality, settings, origin = header["quality"], header["settings"], header["origin"]
    if not isinstance(settings, dict) or len(settings) > MAX_SETTINGS:
        raise InvalidValueError("settings", settings, f"at most {MAX_SETTINGS} named numbers")
    return Provenance(
        quality=None if quality is None else _quality(quality),
        settings={check_text("settings", k): _JSON.number(f"settings.{k}", v, -1e9, 1e9) for k, v in settings.items()},
        origin=None if origin is None else _origin(origin),
    )


def _quality(document: object) -> TrainingQuality:
    found = _JSON.fields("quality", document, required=tuple(QUALITY_BOUNDS))
    return TrainingQuality(
        **{name: _JSON.number(f"quality.{name}", found[name], *bounds) for name, bounds in QUALITY_BOUNDS.items()}
    )


def _origin(document: object) -> ModelOrigin:
    names = tuple(field.name for field in fields(ModelOrigin))
    found = _JSON.fields("origin", document, required=names)
    return ModelOrigin(**{name: check_text(f"origin.{name}", found[name]) for name in names})


def _lie_in(array: FloatArray, low: float, high: float) -> bool:
    return bool(((array >= low) & (array <= high)).all())  # so that NaN fails


def _sha256(name: str, value: object) -> str:
    if not isinstance(value, str) or len(value) != 64 or not set(value) <= set("0123456789abcdef"):
        raise InvalidValueError(name, value, "a SHA-256 in hexadecimal")
    return value
