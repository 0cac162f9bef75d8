"""Measure a recording as fast as it can be read, with the very pipeline that measures live.

Training happens in line, so the same recording gives the same numbers every time. Time for the gate is the device's.
"""

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TextIO

import numpy as np

from engine.calibration import Calibration
from engine.capture.source import DepthSource
from engine.clock import NS_PER_US, ManualClock
from engine.commands import Arm
from engine.errors import ModelError, RecordingError, SourceEndedError
from engine.frames import FloatArray, Measurement, MeasurementState, Motion
from engine.limits import GateLimits
from engine.model_file import save_model
from engine.pipeline import Pipeline, PipelineSettings
from engine.stages.gate import Gate, step_gate
from engine.stages.regions import grid_shape
from engine.training import InlineTrainer

READ_TIMEOUT_S = 5.0
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


@dataclass(frozen=True, slots=True, kw_only=True)
class OfflineSummary:
    """What a batch run amounts to.

    ``shortcoming`` says why nobody would be let arm with this model; ``damage`` why a recording was not read to its
    end.
    """

    frames: int
    measured: int
    lost: int
    missed_frames: int
    training_frames: int
    cycles: int
    shortcoming: str | None = None
    damage: str | None = None


def measure_recording(
    source: DepthSource,
    calibration: Calibration,
    out: Path,
    *,
    settings: PipelineSettings,
    limits: GateLimits | None = None,
    on_frame: Callable[[Measurement], None] | None = None,
) -> OfflineSummary:
    """Measure every frame of ``source`` and write ``motion.csv``, ``regions.npz`` and ``model.npz`` to ``out``.

    With ``limits`` the gate is armed at the first measured frame, so the file shows what it would have decided; without
    them it stays disarmed. The files appear whole or not at all. A recording that turns out damaged is measured up to
    the damage, which the summary then names.

    Raises
    ------
    RecordingError
        Nothing could be read.
    ModelError
        The recording ended before a model could be learned; ``motion.csv`` is written all the same.
    """
    out.mkdir(parents=True, exist_ok=True)
    pipeline = Pipeline(calibration, settings, ManualClock(), InlineTrainer())
    results = _Results(settings)
    damage = None
    partial = out / "motion.csv.partial"
    try:
        with partial.open("w", newline="") as file:
            writer = _MotionWriter(file, settings, _OfflineGate(limits))
            try:
                for measurement in _measurements(source, pipeline):
                    writer.write(measurement)
                    results.add(measurement)
                    if on_frame is not None:
                        on_frame(measurement)
            except RecordingError as error:
                if results.frames == 0:
                    raise
                damage = str(error)
        partial.replace(out / "motion.csv")
    finally:
        partial.unlink(missing_ok=True)
    results.save(out / "regions.npz")
    if pipeline.model is None:
        msg = f"{results.frames} frames were not enough to learn a motion model: {_why(results)}"
        raise ModelError(msg)
    save_model(pipeline.model, out / "model.npz")
    return results.summary(pipeline, damage)


def _measurements(source: DepthSource, pipeline: Pipeline) -> Iterator[Measurement]:
    try:
        source.open()
        while True:
            try:
                frame = source.read(READ_TIMEOUT_S)
            except SourceEndedError:
                return
            yield pipeline.measure(frame)
    finally:
        source.close()


class _MotionWriter:
    """Writes ``motion.csv``: a value that could not be measured is empty, never zero."""

    def __init__(self, file: TextIO, settings: PipelineSettings, gate: "_OfflineGate") -> None:
        self._writer = csv.writer(file, lineterminator="\n")
        self._gate = gate
        self._points = len(settings.points)
        self._writer.writerow([*COLUMNS, *(f"p{row}_{column}_mm" for row, column in settings.points)])

    def write(self, measurement: Measurement) -> None:
        motion = measurement.motion
        numbers = [""] * 4 if motion is None else _texts(motion)
        points = [""] * self._points if motion is None else [_text(value) for value in motion.points_mm]
        gate = self._gate.decide(measurement)
        self._writer.writerow(
            [
                measurement.frame_index,
                measurement.timestamp_us,
                measurement.state.value,
                *numbers,
                gate.state.value,
                "" if gate.reason is None else gate.reason.value,
                *points,
            ]
        )


class _OfflineGate:
    """The live gate's reducer on the device's own time; armed by the first measured frame."""

    def __init__(self, limits: GateLimits | None) -> None:
        self._limits = limits
        self._gate = Gate()
        self._is_armed = False

    def decide(self, measurement: Measurement) -> Gate:
        if self._limits is None:
            return self._gate
        now_ns = measurement.timestamp_us * NS_PER_US
        event = replace(measurement, received_ns=now_ns)
        if not self._is_armed and measurement.state is MeasurementState.MEASURING:
            self._gate = step_gate(self._gate, Arm(operator="offline"), now_ns, self._limits)
            self._is_armed = True
        self._gate = step_gate(self._gate, event, now_ns, self._limits)
        return self._gate


def _texts(motion: Motion) -> list[str]:
    values = (motion.whole_mm, motion.thorax_mm, motion.abdomen_mm)
    return [*(_text(value) for value in values), f"{motion.volume_l:.6f}"]


def _text(value: float) -> str:
    return f"{value:.4f}" if np.isfinite(value) else ""


class _Results:
    """Gathers what goes to ``regions.npz`` and the summary."""

    def __init__(self, settings: PipelineSettings) -> None:
        self._empty = np.full(grid_shape(settings.cell_px), np.nan, dtype=np.float32)
        self._index: list[int] = []
        self._timestamps_us: list[int] = []
        self._depth_mm: list[FloatArray] = []
        self._motion_mm: list[FloatArray] = []
        self._states: list[MeasurementState] = []
        self._missed = 0
        self.last: Measurement | None = None

    @property
    def frames(self) -> int:
        return len(self._index)

    def add(self, measurement: Measurement) -> None:
        motion = measurement.motion
        self._index.append(measurement.frame_index)
        self._timestamps_us.append(measurement.timestamp_us)
        self._depth_mm.append(self._empty if motion is None else motion.regions_depth_mm.astype(np.float32))
        self._motion_mm.append(self._empty if motion is None else motion.regions_mm.astype(np.float32))
        self._states.append(measurement.state)
        self._missed += measurement.missed_frames
        self.last = measurement

    def save(self, path: Path) -> None:
        partial = path.with_name(path.name + ".partial")
        with partial.open("wb") as file:
            np.savez(
                file,
                frame_index=np.array(self._index, dtype=np.int64),
                timestamp_us=np.array(self._timestamps_us, dtype=np.int64),
                depth_mm=np.array(self._depth_mm, dtype=np.float32).reshape(-1, *self._empty.shape),
                motion_mm=np.array(self._motion_mm, dtype=np.float32).reshape(-1, *self._empty.shape),
            )
        partial.replace(path)

    def summary(self, pipeline: Pipeline, damage: str | None) -> OfflineSummary:
        model = pipeline.model
        return OfflineSummary(
            frames=self.frames,
            measured=self._states.count(MeasurementState.MEASURING),
            lost=self._states.count(MeasurementState.LOST),
            missed_frames=self._missed,
            training_frames=0 if model is None else model.training_frames,
            cycles=0 if model is None else model.cycles,
            shortcoming=pipeline.model_shortcoming,
            damage=damage,
        )


def _why(results: _Results) -> str:
    last = results.last
    if last is None:
        return "the recording is empty"
    if last.lost is not None:
        return f"{last.lost.reason.value}: {last.lost.detail}"
    if last.training is not None:
        seen = last.training
        return f"{seen.cycles} complete breathing cycles in {seen.seconds:.0f} s seen. {seen.note}".strip()
    return "training did not finish"
