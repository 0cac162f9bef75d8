"""Measures a recording as fast as it can be read, with the pipeline of a live session.

Training is inline, so a recording gives the same numbers on every run on one processor. The gate's time is the
device's.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from engine.calibration.camera_calibration import Calibration
from engine.capture.source import DepthSource
from engine.core.clock import ManualClock
from engine.core.errors import ModelError, RecordingError, SourceEndedError
from engine.core.frames import Measurement, RgbdFrame
from engine.core.motion_model import MotionModel
from engine.core.provenance import ModelOrigin
from engine.gating.limits import GateLimits
from engine.motion.learning.model_file import save_model
from engine.motion.learning.trainer import InlineTrainer
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from engine.offline.mesh_files import MeshOptions, MeshSaver
from engine.offline.offline_gate import OfflineGate
from engine.offline.result_files import BreathTable, MotionTable, OfflineSummary, Results

READ_TIMEOUT_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FileTask:
    """One recording to measure, with all inputs of its process."""

    recording: Path
    calibration: Path
    out: Path
    settings: PipelineSettings
    limits: GateLimits | None = None
    meshes: MeshOptions | None = None
    model: MotionModel | None = None
    origin: ModelOrigin | None = None


def measure_recording(
    source: DepthSource,
    calibration: Calibration,
    out: Path,
    *,
    settings: PipelineSettings,
    limits: GateLimits | None = None,
    meshes: MeshOptions | None = None,
    on_frame: Callable[[Measurement], None] | None = None,
    model: MotionModel | None = None,
    origin: ModelOrigin | None = None,
) -> OfflineSummary:
    """Measure every frame of ``source``; write the tables, regions.npz, motion_summary.json and model.npz to ``out``.

    With ``limits`` the table shows the decisions of a session's gate that is armed as soon as it may be; without them
    it stays disarmed. Files are written atomically. A damaged recording is measured up to the damage, which the summary
    reports.

    Parameters
    ----------
    meshes
        Frames whose surface is written as a mesh.
    on_frame
        Called with each measurement.
    model
        A stored model to use instead of learning one; it is compared with the patient of this recording, and the first
        measured frame is the reference.
    origin
        Origin of a model fitted here, stored in ``model.npz``.

    Raises
    ------
    RecordingError
        No frame could be read.
    ModelError
        The recording ended before a model was fitted; ``motion.csv`` is still written.
    ModelMismatchError
        The stored model belongs to another calibration, or does not match this patient; nothing is written.
    """
    pipeline = Pipeline(calibration, settings, ManualClock(), InlineTrainer())
    if model is not None:
        pipeline.learner.resume(model)
    out.mkdir(parents=True, exist_ok=True)
    results = Results(settings)
    saver = MeshSaver(out, meshes or MeshOptions())
    gate = OfflineGate(limits)
    with _tables(out, settings) as (table, breaths):

        def write(frame: RgbdFrame, measurement: Measurement) -> None:
            learner = pipeline.learner
            table.write(measurement, gate.decide(frame, measurement, learner.status, learner.take_notices()))
            learner.keep_model(is_kept=gate.is_armed)
            breaths.write(measurement)
            results.add(measurement)
            saver.save(measurement)
            if on_frame is not None:
                on_frame(measurement)

        damage = _measure_frames(source, pipeline, write)
    results.save(out / "regions.npz")
    if pipeline.learner.status.model is None:
        msg = f"{results.frames} frames were not enough to learn a motion model: {_reason_without_model(results)}"
        raise ModelError(msg)
    fitted = pipeline.learner.status.model
    save_model(fitted if origin is None else fitted.from_origin(origin), out / "model.npz")
    summary = replace(
        results.summary(),
        training_frames=fitted.training_frames,
        cycles=fitted.cycles,
        is_split_marked=pipeline.marked_split is not None,
        meshes=tuple(saver.saved),
        shortcoming=pipeline.learner.status.model_shortcoming,
        damage=damage,
    )
    summary.save(out / "motion_summary.json")
    return summary


@contextmanager
def _tables(out: Path, settings: PipelineSettings) -> Iterator[tuple[MotionTable, BreathTable]]:
    """Yield the tables of motion.csv and breathing.csv; the files appear at the end of the block, if it succeeds."""
    partial, breaths_partial = out / "motion.csv.partial", out / "breathing.csv.partial"
    try:
        with partial.open("w", newline="") as file, breaths_partial.open("w", newline="") as breaths_file:
            yield MotionTable(file, settings), BreathTable(breaths_file)
        partial.replace(out / "motion.csv")
        breaths_partial.replace(out / "breathing.csv")
    finally:
        partial.unlink(missing_ok=True)
        breaths_partial.unlink(missing_ok=True)


def _measure_frames(
    source: DepthSource, pipeline: Pipeline, write: Callable[[RgbdFrame, Measurement], None]
) -> str | None:
    """Measure and write every frame; return the damage that ended the recording early, None if it was complete."""
    frames = 0
    try:
        for frame, measurement in _measurements(source, pipeline):
            _raise_mismatch(pipeline)
            write(frame, measurement)
            frames += 1
    except RecordingError as error:
        if frames == 0:
            raise
        return str(error)
    return None


def _measurements(source: DepthSource, pipeline: Pipeline) -> Iterator[tuple[RgbdFrame, Measurement]]:
    try:
        source.open()
        while True:
            try:
                frame = source.read(READ_TIMEOUT_S)
            except SourceEndedError:
                return
            yield frame, pipeline.measure(frame)
    finally:
        source.close()


def _raise_mismatch(pipeline: Pipeline) -> None:
    """Raise the refusal of a stored model: a batch run cannot ask an operator whether to learn a new one."""
    match = pipeline.learner.status.patient_match
    if match is not None and match.refusal is not None:
        raise match.refusal


def _reason_without_model(results: Results) -> str:
    last = results.last
    if last is None:
        return "the recording is empty"
    if last.lost is not None:
        return f"{last.lost.reason.value}: {last.lost.detail}"
    if last.training is not None:
        progress = last.training
        return f"{progress.cycles} complete breathing cycles in {progress.seconds:.0f} s. {progress.note}".strip()
    return "training did not finish"
