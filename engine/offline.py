"""Measure a recording as fast as it can be read, with the very pipeline that measures live.

Training happens in line, so the same recording gives the same numbers every time. Time for the gate is the device's.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from engine.calibration import Calibration
from engine.capture.source import DepthSource
from engine.clock import NS_PER_US, ManualClock
from engine.commands import Arm
from engine.errors import ModelError, RecordingError, SourceEndedError
from engine.frames import Measurement, MeasurementState
from engine.limits import GateLimits
from engine.mesh_files import MeshSaver, MeshWishes
from engine.model import MotionModel
from engine.model_file import save_model
from engine.motion_files import BreathTable, MotionTable, OfflineSummary, Results
from engine.pipeline import Pipeline, PipelineSettings
from engine.provenance import ModelOrigin
from engine.stages.gate import Gate, step_gate
from engine.training import InlineTrainer

READ_TIMEOUT_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FileTask:
    """One recording to measure, with everything its process needs."""

    recording: Path
    calibration: Path
    out: Path
    settings: PipelineSettings
    limits: GateLimits | None = None
    meshes: MeshWishes | None = None
    model: MotionModel | None = None
    origin: ModelOrigin | None = None


def measure_recording(
    source: DepthSource,
    calibration: Calibration,
    out: Path,
    *,
    settings: PipelineSettings,
    limits: GateLimits | None = None,
    meshes: MeshWishes | None = None,
    on_frame: Callable[[Measurement], None] | None = None,
    model: MotionModel | None = None,
    origin: ModelOrigin | None = None,
) -> OfflineSummary:
    """Measure every frame of ``source``; write the tables, regions.npz, motion_summary.json and model.npz to ``out``.

    With ``limits`` the gate is armed at the first measured frame, so the file shows what it would have decided; without
    them it stays disarmed. The files appear whole or not at all. A recording that turns out damaged is measured up to
    the damage, which the summary then names.

    Parameters
    ----------
    meshes
        Of which frames the surface is written too.
    model
        A stored model to measure with instead of learning one; it is compared with the patient of this recording, and
        zero is the first measured frame.
    origin
        What ``model.npz`` says of where a model learned here comes from.

    Raises
    ------
    RecordingError
        Nothing could be read.
    ModelError
        The recording ended before a model could be learned; ``motion.csv`` is written all the same.
    ModelMismatchError
        The stored model is of another calibration, or too far from this patient; nothing is written.
    """
    pipeline = Pipeline(calibration, settings, ManualClock(), InlineTrainer())
    if model is not None:
        pipeline.resume(model)
    out.mkdir(parents=True, exist_ok=True)
    results = Results(settings)
    saver = MeshSaver(out, meshes or MeshWishes())
    gate = _OfflineGate(limits)
    damage = None
    partial, breaths_partial = out / "motion.csv.partial", out / "breathing.csv.partial"
    try:
        with partial.open("w", newline="") as file, breaths_partial.open("w", newline="") as breaths_file:
            table, breaths = MotionTable(file, settings), BreathTable(breaths_file)
            try:
                for measurement in _measurements(source, pipeline):
                    _refuse_unlike(pipeline)
                    table.write(measurement, gate.decide(measurement))
                    breaths.write(measurement)
                    results.add(measurement)
                    saver.save(measurement)
                    if on_frame is not None:
                        on_frame(measurement)
            except RecordingError as error:
                if results.frames == 0:
                    raise
                damage = str(error)
        partial.replace(out / "motion.csv")
        breaths_partial.replace(out / "breathing.csv")
    finally:
        partial.unlink(missing_ok=True)
        breaths_partial.unlink(missing_ok=True)
    results.save(out / "regions.npz")
    if pipeline.model is None:
        msg = f"{results.frames} frames were not enough to learn a motion model: {_why(results)}"
        raise ModelError(msg)
    learned = pipeline.model
    save_model(learned if origin is None else learned.from_origin(origin), out / "model.npz")
    summary = replace(
        results.summary(),
        training_frames=learned.training_frames,
        cycles=learned.cycles,
        is_split_marked=pipeline.marked_split is not None,
        meshes=tuple(saver.saved),
        shortcoming=pipeline.model_shortcoming,
        damage=damage,
    )
    summary.save(out / "motion_summary.json")
    return summary


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


def _refuse_unlike(pipeline: Pipeline) -> None:
    """Raise what a stored model was refused for: a batch run has nobody to ask whether to learn a new one."""
    likeness = pipeline.likeness
    if likeness is not None and likeness.refusal is not None:
        raise likeness.refusal


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


def _why(results: Results) -> str:
    last = results.last
    if last is None:
        return "the recording is empty"
    if last.lost is not None:
        return f"{last.lost.reason.value}: {last.lost.detail}"
    if last.training is not None:
        seen = last.training
        return f"{seen.cycles} complete breathing cycles in {seen.seconds:.0f} s seen. {seen.note}".strip()
    return "training did not finish"
