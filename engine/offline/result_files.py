"""Result files of a batch run: motion.csv, breathing.csv, regions.npz and motion_summary.json.

A value that could not be measured is empty in the tables, NaN in the arrays and null in the summary, never zero. Files
are written atomically.
"""

import csv
import hashlib
import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO, TextIO

import numpy as np

import engine
from engine.core.breath import Breath
from engine.core.files import write_whole
from engine.core.frames import FloatArray, Measurement, MeasurementState, Motion, PhaseLag
from engine.gating.gate import Gate
from engine.motion.settings import PipelineSettings
from engine.motion.stages.regions import grid_shape
from engine.offline.segments import COLUMNS as SEGMENT_COLUMNS, Segments, SegmentSummary

SUMMARY_SCHEMA = "tidegate.motion-summary/1"
COLUMNS = (
    "frame_index",
    "timestamp_us",
    "state",
    "whole_mm",
    "thorax_mm",
    "abdomen_mm",
    "volume_l",
    "gate",
    "hold_reason",
    *SEGMENT_COLUMNS,
)
BREATH_COLUMNS = (
    "frame_index",
    "timestamp_us",
    "phase_percent",
    "phase_confidence",
    "rate_per_min",
    "amplitude_mm",
    "baseline_mm",
    "drift_mm",
    "drift_mm_s",
    "regularity",
    "events",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class LagSummary:
    """Phase lag between two regions over a recording.

    Attributes
    ----------
    told_share
        Share of the measured frames with a lag, 0 to 1.
    lag_s, lag_deg, period_s, confidence
        Medians over those frames; for the angle the circular mean, and the lag [s] that follows from it; None if no
        frame has a lag.
    note
        The most frequent reason of frames without a lag; empty if there are none.
    """

    first: str
    second: str
    told_share: float
    lag_s: float | None
    lag_deg: float | None
    period_s: float | None
    confidence: float | None
    note: str


@dataclass(frozen=True, slots=True, kw_only=True)
class OfflineSummary:
    """Summary of a batch run; its fields are the keys of motion_summary.json.

    Attributes
    ----------
    in_training, measured, lost
        Frames by their state in motion.csv; they add up to ``frames``.
    missed_frames
        Frames that the camera dropped: gaps in the recording, not part of ``frames``.
    training_frames
        Frames that the model was trained on; not more than ``in_training`` unless the model is a stored one.
    whole_pp_mm
        Peak-to-peak motion of the whole region [mm]; None if nothing was measured.
    residual_mean_mm, residual_max_mm
        Residual over the measured frames [mm].
    recording_s
        Device time from the first frame to the last [s].
    split_rows
        Rows at which the line between thorax and abdomen crosses columns 0 and 199.
    is_split_marked
        Whether stickers at the costal margin mark that line.
    shortcoming
        Why arming with this model would be refused; None if it would not.
    damage
        Why the recording was not read to its end; None if it was.
    passes
        2 if every frame was measured with the model that the recording's first pass learned, 1 if as in a live session.
    live_from_frame
        Index of the first frame that a live session measures; None if there is none.
    predicted_duty_percent
        Share of the learned breaths inside the gating window, 0 to 100, as a session predicts it; None without one.
    duty_refusal
        Why a session would refuse to arm with this window; None if it would not.
    segments
        Stretches in which patient, couch and camera stay where they are.
    reference_uncertainty_mm
        Standard uncertainty of the reference: what it adds to a point's motion in every frame; None if not known.
    """

    frames: int
    measured: int
    lost: int
    missed_frames: int
    training_frames: int
    cycles: int
    in_training: int = 0
    whole_pp_mm: float | None = None
    residual_mean_mm: float | None = None
    residual_max_mm: float | None = None
    recording_s: float = 0.0
    split_rows: tuple[float, float] | None = None
    is_split_marked: bool = False
    lags: tuple[LagSummary, ...] = ()
    meshes: tuple[str, ...] = ()
    shortcoming: str | None = None
    damage: str | None = None
    passes: int = 1
    live_from_frame: int | None = None
    predicted_duty_percent: float | None = None
    duty_refusal: str | None = None
    segments: tuple[SegmentSummary, ...] = ()
    reference_uncertainty_mm: float | None = None

    def save(self, path: Path) -> None:
        """Write the summary as JSON, atomically; the same values give the same bytes."""
        document = {"schema": SUMMARY_SCHEMA, **asdict(self)}
        text = json.dumps(document, indent=1, allow_nan=False) + "\n"
        write_whole(path, text.encode())


class MotionTable:
    """Writes ``motion.csv``, one row per frame: the fixed columns, then points, then named regions [mm]."""

    def __init__(self, file: TextIO, settings: PipelineSettings) -> None:
        self._writer = csv.writer(file, lineterminator="\n")
        points = [f"p{row}_{column}_mm" for row, column in settings.points]
        named = [f"{region.name}_mm" for region in settings.named]
        self._writer.writerow([*COLUMNS, *points, *named])
        self._nothing = [""] * (len(points) + len(named))
        self.segments = Segments()

    def write(self, measurement: Measurement, gate: Gate) -> None:
        """Write a frame's row."""
        motion = measurement.motion
        self._writer.writerow(
            [
                measurement.frame_index,
                measurement.timestamp_us,
                measurement.state.value,
                *([""] * 4 if motion is None else _wide(motion)),
                gate.state.value,
                "" if gate.reason is None else gate.reason.value,
                *self.segments.follow(measurement),
                *(self._nothing if motion is None else _texts([*motion.points_mm, *motion.named_mm])),
            ]
        )


class BreathTable:
    """Writes ``breathing.csv``, one row per frame: phase and breathing figures of the first breathing signal."""

    def __init__(self, file: TextIO) -> None:
        self._writer = csv.writer(file, lineterminator="\n")
        self._writer.writerow(BREATH_COLUMNS)

    def write(self, measurement: Measurement) -> None:
        """Write a frame's row; unknown values are empty."""
        figures = _breath(measurement.breaths[0]) if measurement.breaths else [""] * (len(BREATH_COLUMNS) - 2)
        self._writer.writerow([measurement.frame_index, measurement.timestamp_us, *figures])


class Results:
    """Collects the measurements for ``regions.npz`` and the summary."""

    def __init__(self, settings: PipelineSettings) -> None:
        self._names = [region.name for region in settings.named]
        self._pairs = [(first, second) for first, _, second, _ in settings.lag_pairs()]
        self._cells = np.full(grid_shape(settings.cell_px), np.nan, dtype=np.float32)
        self._unnamed = np.full(len(self._names), np.nan, dtype=np.float32)
        self._measurements: list[tuple[int, int, MeasurementState]] = []
        self._motions: list[Motion | None] = []
        self._rows: list[tuple[FloatArray, FloatArray, FloatArray, FloatArray]] = []
        self._whole_mm: list[float] = []
        self._residual_mm: list[float] = []
        self._lags: list[tuple[PhaseLag, ...]] = []
        self._split_rows: tuple[float, float] | None = None
        self._missed = 0
        self.last: Measurement | None = None
        """The last frame's measurement."""

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self._measurements)

    def add(self, measurement: Measurement) -> None:
        """Add a frame."""
        self.last = measurement
        self._missed += measurement.missed_frames
        self._measurements.append((measurement.frame_index, measurement.timestamp_us, measurement.state))
        motion = measurement.motion
        if motion is None:
            self._rows.append((self._cells, self._cells, self._unnamed, self._cells))
            self._lags.append(())
            return
        self._rows.append(
            (
                motion.regions_depth_mm.astype(np.float32),
                motion.regions_mm.astype(np.float32),
                motion.named_mm.astype(np.float32),
                motion.seen.cells.astype(np.float32),
            )
        )
        self._lags.append(motion.lags)
        self._whole_mm.append(motion.whole_mm)
        self._residual_mm.append(motion.projection.residual_mm)
        self._split_rows = motion.split_rows

    def save(self, path: Path) -> None:
        """Write ``regions.npz`` atomically."""
        write_whole(path, self._write)

    def _write(self, file: BinaryIO) -> None:
        depth, motion, named, seen = zip(*self._rows, strict=True) if self._rows else ((), (), (), ())
        pairs = len(self._pairs)
        lags = np.array([_lag_numbers(lags, pairs) for lags in self._lags], dtype=np.float32).reshape(-1, pairs, 3)
        np.savez(  # uncompressed: the cells' noise compresses little, and slowly
            file,
            frame_index=np.array([index for index, _, _ in self._measurements], dtype=np.int64),
            timestamp_us=np.array([at_us for _, at_us, _ in self._measurements], dtype=np.int64),
            depth_mm=np.array(depth, dtype=np.float32).reshape(self.frames, *self._cells.shape),
            motion_mm=np.array(motion, dtype=np.float32).reshape(self.frames, *self._cells.shape),
            seen=np.array(seen, dtype=np.float32).reshape(self.frames, *self._cells.shape),
            named=np.array(self._names, dtype=np.str_),
            named_mm=np.array(named, dtype=np.float32).reshape(self.frames, len(self._names)),
            lag_pairs=np.array(self._pairs, dtype=np.str_),
            lag_s=lags[:, :, 0],
            lag_deg=lags[:, :, 1],
            lag_confidence=lags[:, :, 2],
        )

    def summary(self) -> OfflineSummary:
        """Compute the summary, without the fields that only the pipeline has."""
        states = [state for _, _, state in self._measurements]
        times_us = [at for _, at, _ in self._measurements]
        return OfflineSummary(
            frames=self.frames,
            measured=states.count(MeasurementState.MEASURING),
            lost=states.count(MeasurementState.LOST),
            missed_frames=self._missed,
            training_frames=0,
            cycles=0,
            in_training=states.count(MeasurementState.TRAINING),
            whole_pp_mm=float(np.ptp(self._whole_mm)) if self._whole_mm else None,
            residual_mean_mm=float(np.mean(self._residual_mm)) if self._residual_mm else None,
            residual_max_mm=float(np.max(self._residual_mm)) if self._residual_mm else None,
            recording_s=(times_us[-1] - times_us[0]) / 1e6 if times_us else 0.0,
            split_rows=self._split_rows,
            lags=tuple(_lag_summary(pair, lags) for pair, lags in zip(self._pairs, self._pair_lags(), strict=True)),
        )

    def _pair_lags(self) -> list[list[PhaseLag]]:
        """Return the lags of each pair, one per measured frame."""
        measured = [lags for lags in self._lags if lags]
        return [[lags[position] for lags in measured] for position in range(len(self._pairs))]


def _breath(breath: Breath) -> list[str]:
    values = (breath.rate_per_min, breath.amplitude, breath.baseline, breath.drift, breath.drift_per_s)
    phase = breath.phase_percent
    return [
        # Truncated, not rounded: 100 % is the next breath's 0 %.
        "" if phase is None else f"{math.floor(phase * 100.0) / 100.0:.2f}",
        "" if phase is None else f"{breath.phase_confidence:.3f}",
        *_texts([*map(_number, values), _number(breath.regularity)]),
        ";".join(event.kind.value for event in breath.events),
    ]


def _wide(motion: Motion) -> list[str]:
    return [*_texts([motion.whole_mm, motion.thorax_mm, motion.abdomen_mm]), f"{motion.volume_l:.6f}"]


def _texts(values: Iterable[float]) -> list[str]:
    return [f"{value:.4f}" if np.isfinite(value) else "" for value in values]


def _lag_numbers(lags: tuple[PhaseLag, ...], pairs: int) -> list[tuple[float, float, float]]:
    if not lags:
        return [(np.nan, np.nan, np.nan)] * pairs
    return [
        (_number(lag.lag_s), _number(lag.lag_deg), _number(lag.confidence if lag.lag_s is not None else None))
        for lag in lags
    ]


def _number(value: float | None) -> float:
    return np.nan if value is None else value


def _lag_summary(pair: tuple[str, str], lags: list[PhaseLag]) -> LagSummary:
    known = [lag for lag in lags if lag.lag_s is not None]
    notes = [lag.note for lag in lags if lag.note]
    directions = np.exp(1j * np.deg2rad([_number(lag.lag_deg) for lag in known]))
    lag_deg = float(np.rad2deg(np.angle(directions.mean()))) if known else None
    period_s = _median(known, "period_s")
    return LagSummary(
        first=pair[0],
        second=pair[1],
        told_share=len(known) / len(lags) if lags else 0.0,
        # Near half a cycle the sign of the lag alternates, so average the angle on the circle, not the seconds.
        lag_s=None if lag_deg is None or period_s is None else lag_deg / 360.0 * period_s,
        lag_deg=lag_deg,
        period_s=period_s,
        confidence=_median(known, "confidence"),
        note=max(set(notes), key=notes.count) if notes else "",
    )


def _median(lags: list[PhaseLag], name: str) -> float | None:
    return float(np.median([getattr(lag, name) for lag in lags])) if lags else None


@lru_cache
def fingerprint(*patterns: str) -> str:
    """Hash the source of the modules that match glob patterns, relative to the folder in which ``engine`` stands.

    A cached measurement is valid as long as the fingerprint of the code that it depends on is unchanged.
    """
    root = Path(engine.__file__).parent.parent
    digest = hashlib.sha256()
    for path in sorted({path for pattern in patterns for path in root.glob(pattern)}):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]
