"""Measurements of every method on one recording, stored with the truth in ``measured.npz``."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from engine.core.files import whole_file
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, FloatArray
from lab.phantom.truth import CELL_PX, POINTS_RC

CELLS = (ROI_ROWS // CELL_PX, ROI_COLUMNS // CELL_PX)
HALF_ROWS = ROI_ROWS // 2
COEFFICIENTS = 3
TRAINING, MEASURING, LOST = 0, 1, 2

Array = npt.NDArray[Any]
_COLUMNS = ("timestamp_us", "state", "residual_mm", "valid_share", "is_trusted")
_GROUPS = ("spectra", "pictures", "instruments")


@dataclass(slots=True, kw_only=True, eq=False)
class Track:
    """Measurements of one method: one row per frame, NaN where not measured; motion from its first measured frame.

    Attributes
    ----------
    cells_mm, wide_mm, points_mm
        Motion of the cells, shape (n, 35, 20); of whole, thorax and abdomen, shape (n, 3); of the five points, (n, 5).
    volume_l
        Volume relative to the same frame [l], shape (n,).
    beta
        Coefficients of the first three components, shape (n, 3).
    """

    cells_mm: FloatArray
    wide_mm: FloatArray
    points_mm: FloatArray
    volume_l: FloatArray
    beta: FloatArray

    @classmethod
    def empty(cls, frames: int) -> "Track":
        """Return a track without measurements."""
        return cls(
            cells_mm=np.full((frames, *CELLS), np.nan, dtype=np.float32),
            wide_mm=np.full((frames, 3), np.nan),
            points_mm=np.full((frames, len(POINTS_RC)), np.nan),
            volume_l=np.full(frames, np.nan),
            beta=np.full((frames, COEFFICIENTS), np.nan),
        )

    @property
    def is_measured(self) -> BoolArray:
        """Measured frames, shape (n,)."""
        return np.isfinite(self.wide_mm[:, 0])

    @property
    def reference(self) -> int | None:
        """Index of the first measured frame, the reference; None if there is none."""
        measured = np.flatnonzero(self.is_measured)
        return int(measured[0]) if len(measured) else None

    def set_surface(self, index: int, surface_mm: FloatArray) -> None:
        """Store a frame's surface, shape (350, 200) [mm], as depth; `finish` converts depth to motion."""
        thorax, abdomen = float(surface_mm[:HALF_ROWS].mean()), float(surface_mm[HALF_ROWS:].mean())
        self.cells_mm[index] = cell_means(surface_mm)
        self.wide_mm[index] = (0.5 * (thorax + abdomen), thorax, abdomen)
        self.points_mm[index] = surface_mm[POINTS_RC[:, 0], POINTS_RC[:, 1]]

    def finish(self) -> None:
        """Convert depth to motion from the first measured frame."""
        first = self.reference
        if first is None:
            return
        for depth in (self.cells_mm, self.wide_mm, self.points_mm):
            depth[:] = depth[first].copy() - depth


def cell_means(surface_mm: FloatArray) -> FloatArray:
    """Mean of the cells of 10 x 10 points, shape (..., 350, 200) to (..., 35, 20)."""
    blocks = surface_mm.reshape(*surface_mm.shape[:-2], CELLS[0], CELL_PX, CELLS[1], CELL_PX)
    return np.asarray(blocks.mean(axis=(-3, -1)))


@dataclass(slots=True, kw_only=True, eq=False)
class Outcome:
    """Content of ``measured.npz``: all measurements of a run, n frames.

    Attributes
    ----------
    truth
        A `Track` of depth [mm] instead of motion.
    tracks
        By name: ``plain``, ``ours``, ``oracle``; of long runs also ``plain1`` and ``ours1`` with one component; of
        pictured runs also ``bilateral``.
    state
        Tidegate's state in each frame: 0 training, 1 measuring, 2 lost; shape (n,).
    residual_mm, valid_share
        Tidegate's residual [mm] and share of valid pixels, NaN where it did not measure, shape (n,).
    is_trusted
        Whether the frame passes the frame checks with the gate's default limits, shape (n,).
    spectra
        First ten eigenvalues as shares of the sum of all, of ``plain`` and ``ours``.
    pictures
        Surfaces on the ROI grid by name, of pictured runs.
    instruments
        Measurements of laser line and spirometer, if there were any.
    notes
        Reasons of lost frames with their counts, training frames and cycles, modes of the oracle.
    events
        The truth's labelled events: ``name``, ``start_us``, ``end_us``, ``detail``.
    """

    timestamp_us: npt.NDArray[np.int64]
    truth: Track
    state: npt.NDArray[np.int8]
    residual_mm: FloatArray
    valid_share: FloatArray
    is_trusted: BoolArray
    tracks: dict[str, Track] = field(default_factory=dict)
    spectra: dict[str, FloatArray] = field(default_factory=dict)
    pictures: dict[str, FloatArray] = field(default_factory=dict)
    instruments: dict[str, Array] = field(default_factory=dict)
    notes: dict[str, Any] = field(default_factory=dict)
    events: list[dict[str, Any]] = field(default_factory=list)

    @property
    def seconds(self) -> FloatArray:
        """Device time of each frame since the first [s], shape (n,)."""
        return np.asarray((self.timestamp_us - self.timestamp_us[0]) * 1e-6)

    def within(self, event: str) -> BoolArray:
        """Frames within events of that name, shape (n,)."""
        inside = np.zeros(len(self.timestamp_us), dtype=np.bool_)
        for found in self.events:
            if found["name"] == event:
                inside |= (self.timestamp_us >= found["start_us"]) & (self.timestamp_us < found["end_us"])
        return inside

    def save(self, path: Path) -> None:
        """Write the file atomically."""
        arrays: dict[str, Array] = {name: getattr(self, name) for name in _COLUMNS}
        for name, track in {"truth": self.truth, **self.tracks}.items():
            arrays |= {f"tracks/{name}/{key}": getattr(track, key).astype(np.float32) for key in _TRACK}
        for group in _GROUPS:
            arrays |= {f"{group}/{name}": np.asarray(values) for name, values in getattr(self, group).items()}
        words = json.dumps({"notes": self.notes, "events": self.events}, sort_keys=True)
        with whole_file(path) as file:
            np.savez_compressed(file, allow_pickle=False, words=np.array(words), **arrays)

    @classmethod
    def load(cls, path: Path) -> "Outcome":
        """Read a file written by `save`."""
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: file[key] for key in file.files}
        words = json.loads(str(arrays.pop("words")))
        known: dict[str, Any] = {key: arrays[key] for key in _COLUMNS}
        known |= {group: _under(arrays, group) for group in _GROUPS} | words
        values = _under(arrays, "tracks")
        names = sorted({key.split("/")[0] for key in values})
        tracks = {name: Track(**_under(values, name)) for name in names}
        return cls(truth=tracks.pop("truth"), tracks=tracks, **known)


_TRACK = tuple(Track.__dataclass_fields__)


def _under(arrays: dict[str, Array], group: str) -> dict[str, Array]:
    return {key.removeprefix(f"{group}/"): value for key, value in arrays.items() if key.startswith(f"{group}/")}
