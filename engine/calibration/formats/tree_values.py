"""Numbers, matrices and names from foreign trees; refusals use the names of the source."""

import re
from collections.abc import Iterable

import numpy as np

from engine.calibration.formats.documents import Tree
from engine.core.errors import CalibrationError
from engine.core.frames import FloatArray

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,3})?")
_MAX_DIGITS = 60
_LARGEST = 1e9
_MATRIX_KEYS = {"rows", "cols", "dt", "data", "type_id"}
# OpenCV's letters for numbers of one channel.
_MATRIX_TYPES = {"d", "f", "i", "s", "w", "c", "u", "1d", "1f"}


def number(field: str, value: Tree) -> float:
    """Take a finite number, written as text or not."""
    if isinstance(value, str) and len(value) <= _MAX_DIGITS and _NUMBER.fullmatch(value):
        value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _LARGEST:
        raise CalibrationError(field, value, f"a number from {-_LARGEST:g} to {_LARGEST:g}")
    return float(value)


def whole(field: str, value: Tree) -> int:
    """Take a whole number."""
    found = number(field, value)
    if found != int(found):
        raise CalibrationError(field, value, "a whole number")
    return int(found)


def text(field: str, value: Tree) -> str:
    """Take a text."""
    if not isinstance(value, str):
        raise CalibrationError(field, value, "a text")
    return value


def numbers(field: str, value: Tree) -> list[float]:
    """Take a list of numbers."""
    if not isinstance(value, list):
        raise CalibrationError(field, value, "a list of numbers")
    return [number(f"{field}[{i}]", item) for i, item in enumerate(value)]


def matrix(field: str, value: Tree) -> FloatArray:
    """Take a matrix as OpenCV and ROS write it, ``rows``, ``cols`` and ``data``; shape (rows, cols), float64."""
    if not isinstance(value, dict) or not {"rows", "cols", "data"} <= value.keys():
        raise CalibrationError(field, value, "a matrix: rows, cols and data")
    refuse_unknown(value.keys(), _MATRIX_KEYS, prefix=f"{field}.")
    kind = value.get("dt", "d")
    if kind not in _MATRIX_TYPES:
        raise CalibrationError(f"{field}.dt", kind, "one channel of numbers (d, f or i)")
    rows, columns = (whole(f"{field}.{key}", value[key]) for key in ("rows", "cols"))
    entries = numbers(f"{field}.data", value["data"])
    if rows < 0 or columns < 0 or rows * columns != len(entries):
        raise CalibrationError(f"{field}.data", f"{len(entries)} numbers", f"rows x cols ({rows} x {columns})")
    return np.array(entries, dtype=np.float64).reshape(rows, columns)


def shaped(field: str, value: FloatArray, *shapes: tuple[int, int]) -> FloatArray:
    """Refuse a matrix of another shape."""
    if value.shape not in shapes:
        wanted = " or ".join(f"{rows} x {columns}" for rows, columns in shapes)
        raise CalibrationError(field, f"{value.shape[0]} x {value.shape[1]}", wanted)
    return value


def camera_matrix(field: str, value: FloatArray) -> dict[str, float]:
    """Take fx, fy, cx, cy out of a camera matrix without skew, shape (3, 3)."""
    shaped(field, value, (3, 3))
    rest = (value[0, 1], value[1, 0], *value[2])
    if not np.allclose(rest, (0.0, 0.0, 0.0, 0.0, 1.0), rtol=0.0, atol=1e-9):
        raise CalibrationError(field, value.tolist(), "a camera matrix: fx 0 cx, 0 fy cy, 0 0 1")
    entries = {"fx": value[0, 0], "fy": value[1, 1], "cx": value[0, 2], "cy": value[1, 2]}
    return {key: float(entry) for key, entry in entries.items()}


def distortion(field: str, entries: list[float]) -> list[float]:
    """Take k1 k2 p1 p2 k3 out of OpenCV's 4, 5, 8, 12 or 14 coefficients; those beyond must be zero."""
    if len(entries) not in {0, 4, 5, 8, 12, 14}:
        raise CalibrationError(field, f"{len(entries)} numbers", "4, 5, 8, 12 or 14 coefficients")
    for i, entry in enumerate(entries[5:], start=5):
        if entry != 0.0:
            bound = "0: only k1 k2 p1 p2 k3 are used here; calibrate again without a rational model"
            raise CalibrationError(f"{field}[{i}]", entry, bound)
    return (entries + [0.0] * 5)[:5]


def refuse_unknown(keys: Iterable[str], known: Iterable[str], *, prefix: str = "") -> None:
    """Raise CalibrationError for unknown keys."""
    known = set(known)
    for key in keys:
        if key not in known:
            raise CalibrationError(f"{prefix}{key}"[:80], "unknown", f"one of {', '.join(sorted(known))}")
