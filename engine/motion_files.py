"""What a batch run leaves in its folder: motion.csv, breathing.csv, regions.npz and motion_summary.json.

A value that could not be measured is empty in the table, NaN in the arrays and null in the summary, never zero. Each
file appears whole or not at all.
"""

import csv
import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO, TextIO

import numpy as np

from engine.breath import Breath
from engine.frames import FloatArray, Measurement, MeasurementState, Motion, PhaseLag
from engine.pipeline import PipelineSettings
from engine.stages.gate import Gate
from engine.stages.regions import grid_shape
from engine.whole_files import write_whole

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
    """What a recording says of the lag between two regions.

    Attributes
    ----------
    told_share
        Share of the measured frames at which it could be told.
    lag_s, lag_deg, period_s, confidence
        Medians over those frames, of the angle its mean direction; None when it never could.
    note
        Why it could not be told, as was said most often; empty when it always could.
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
    """What a batch run amounts to.

    Attributes
    ----------
    whole_pp_mm
        From the lowest to the highest motion of the whole [mm]; None when nothing was measured.
    residual_mean_mm, residual_max_mm
        Over the measured frames [mm].
    recording_s
        Device time from the first frame to the last [s].
    split_rows
        Where the line between thorax and abdomen crosses column 0 and 199 [row].
    is_split_marked
        Whether the patient's own stickers told it.
    shortcoming
        Why nobody would be let arm with this model.
    damage
        Why a recording was not read to its end.
    """

    frames: int
    measured: int
    lost: int
    missed_frames: int
    training_frames: int
    cycles: int
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

    def save(self, path: Path) -> None:
        """Write it as JSON; the same values give the same bytes."""
        document = {"schema": SUMMARY_SCHEMA, **asdict(self)}
        text = json.dumps(document, indent=1, allow_nan=False) + "\n"
        write_whole(path, lambda file: file.write(text.encode()))


class MotionTable:
    """Writes ``motion.csv``, a row a frame: what the design fixes, then points, then named regions."""

    def __init__(self, file: TextIO, settings: PipelineSettings) -> None:
        self._writer = csv.writer(file, lineterminator="\n")
        points = [f"p{row}_{column}_mm" for row, column in settings.points]
        named = [f"{region.name}_mm" for region in settings.named]
        self._writer.writerow([*COLUMNS, *points, *named])
        self._nothing = [""] * (len(points) + len(named))

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
                *(self._nothing if motion is None else _texts([*motion.points_mm, *motion.named_mm])),
            ]
        )


class BreathTable:
    """Writes ``breathing.csv``, a row a frame: where the first signal that is followed stands in its breath."""

    def __init__(self, file: TextIO) -> None:
        self._writer = csv.writer(file, lineterminator="\n")
        self._writer.writerow(BREATH_COLUMNS)

    def write(self, measurement: Measurement) -> None:
        """Write a frame's row; empty where nothing is known."""
        told = _breath(measurement.breaths[0]) if measurement.breaths else [""] * (len(BREATH_COLUMNS) - 2)
        self._writer.writerow([measurement.frame_index, measurement.timestamp_us, *told])


class Results:
    """Gathers what goes to ``regions.npz`` and to the summary."""

    def __init__(self, settings: PipelineSettings) -> None:
        self._names = [region.name for region in settings.named]
        self._pairs = [(first, second) for first, _, second, _ in settings.lag_pairs()]
        self._cells = np.full(grid_shape(settings.cell_px), np.nan, dtype=np.float32)
        self._unnamed = np.full(len(self._names), np.nan, dtype=np.float32)
        self._measurements: list[tuple[int, int, MeasurementState]] = []
        self._motions: list[Motion | None] = []
        self._rows: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        self._whole_mm: list[float] = []
        self._residual_mm: list[float] = []
        self._lags: list[tuple[PhaseLag, ...]] = []
        self._split_rows: tuple[float, float] | None = None
        self._missed = 0
        self.last: Measurement | None = None
        """The last frame's outcome."""

    @property
    def frames(self) -> int:
        """How many frames there were."""
        return len(self._measurements)

    def add(self, measurement: Measurement) -> None:
        """Take a frame."""
        self.last = measurement
        self._missed += measurement.missed_frames
        self._measurements.append((measurement.frame_index, measurement.timestamp_us, measurement.state))
        motion = measurement.motion
        if motion is None:
            self._rows.append((self._cells, self._cells, self._unnamed))
            self._lags.append(())
            return
        self._rows.append(
            (
                motion.regions_depth_mm.astype(np.float32),
                motion.regions_mm.astype(np.float32),
                motion.named_mm.astype(np.float32),
            )
        )
        self._lags.append(motion.lags)
        self._whole_mm.append(motion.whole_mm)
        self._residual_mm.append(motion.projection.residual_mm)
        self._split_rows = motion.split_rows

    def save(self, path: Path) -> None:
        """Write ``regions.npz``."""
        write_whole(path, self._write)

    def _write(self, file: BinaryIO) -> None:
        depth, motion, named = zip(*self._rows, strict=True) if self._rows else ((), (), ())
        pairs = len(self._pairs)
        lags = np.array([_lag_numbers(lags, pairs) for lags in self._lags], dtype=np.float32).reshape(-1, pairs, 3)
        np.savez(  # the noise of the cells packs to little less, and packing takes long
            file,
            frame_index=np.array([index for index, _, _ in self._measurements], dtype=np.int64),
            timestamp_us=np.array([at_us for _, at_us, _ in self._measurements], dtype=np.int64),
            depth_mm=np.array(depth, dtype=np.float32).reshape(self.frames, *self._cells.shape),
            motion_mm=np.array(motion, dtype=np.float32).reshape(self.frames, *self._cells.shape),
            named=np.array(self._names, dtype=np.str_),
            named_mm=np.array(named, dtype=np.float32).reshape(self.frames, len(self._names)),
            lag_pairs=np.array(self._pairs, dtype=np.str_),
            lag_s=lags[:, :, 0],
            lag_deg=lags[:, :, 1],
            lag_confidence=lags[:, :, 2],
        )

    def summary(self) -> OfflineSummary:
        """Sum up, without what only the pipeline knows."""
        states = [state for _, _, state in self._measurements]
        times_us = [at for _, at, _ in self._measurements]
        return OfflineSummary(
            frames=self.frames,
            measured=states.count(MeasurementState.MEASURING),
            lost=states.count(MeasurementState.LOST),
            missed_frames=self._missed,
            training_frames=0,
            cycles=0,
            whole_pp_mm=float(np.ptp(self._whole_mm)) if self._whole_mm else None,
            residual_mean_mm=float(np.mean(self._residual_mm)) if self._residual_mm else None,
            residual_max_mm=float(np.max(self._residual_mm)) if self._residual_mm else None,
            recording_s=(times_us[-1] - times_us[0]) / 1e6 if times_us else 0.0,
            split_rows=self._split_rows,
            lags=tuple(_lag_summary(pair, told) for pair, told in zip(self._pairs, self._told(), strict=True)),
        )

    def _told(self) -> list[list[PhaseLag]]:
        """Return what was said of each pair, one a measured frame."""
        said = [lags for lags in self._lags if lags]
        return [[lags[position] for lags in said] for position in range(len(self._pairs))]


def _breath(breath: Breath) -> list[str]:
    values = (breath.rate_per_min, breath.amplitude, breath.baseline, breath.drift, breath.drift_per_s)
    phase = breath.phase_percent
    return [
        # Cut, not rounded: 100 is the next breath's 0.
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


def _lag_summary(pair: tuple[str, str], said: list[PhaseLag]) -> LagSummary:
    told = [lag for lag in said if lag.lag_s is not None]
    notes = [lag.note for lag in said if lag.note]
    turns = np.exp(1j * np.deg2rad([_number(lag.lag_deg) for lag in told]))
    lag_deg = float(np.rad2deg(np.angle(turns.mean()))) if told else None
    period_s = _median(told, "period_s")
    return LagSummary(
        first=pair[0],
        second=pair[1],
        told_share=len(told) / len(said) if said else 0.0,
        # A lag near half a cycle is told now as before, now as after: its direction has a mean, its seconds have none.
        lag_s=None if lag_deg is None or period_s is None else lag_deg / 360.0 * period_s,
        lag_deg=lag_deg,
        period_s=period_s,
        confidence=_median(told, "confidence"),
        note=max(set(notes), key=notes.count) if notes else "",
    )


def _median(told: list[PhaseLag], name: str) -> float | None:
    return float(np.median([getattr(lag, name) for lag in told])) if told else None
