"""Measures a recording as fast as it can be read, with the pipeline of a live session, in two passes.

The first pass does what a live session does: it learns the motion model from the first breaths. The second pass reads
the recording again and measures every frame, so that the frames of the training are not lost, with a model of the whole
recording (`engine.motion.learning.past_frames`), and its motion is smoothed over the neighbouring frames; the gate
decides by each frame alone, as a session's does. In both, the first measured frame is the reference. Frames are
streamed. Training is inline, so a recording gives the same numbers on every run on one processor. The gate's time is
the device's.
"""

import contextlib
import math
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from engine.calibration.camera_calibration import Calibration
from engine.capture.source import DepthSource
from engine.core.clock import ManualClock
from engine.core.errors import CommandRefusedError, InvalidValueError, ModelError, RecordingError, SourceEndedError
from engine.core.frames import Measurement, MeasurementState, RgbdFrame
from engine.core.motion_model import ModelOrigin, MotionModel
from engine.gating.active_window import duty_percent, refuse_hold_in_free_breath, refuse_never_left
from engine.gating.gate import Gate
from engine.gating.limits import GateLimits
from engine.motion.learning.learner import Learner
from engine.motion.learning.model_file import save_model
from engine.motion.learning.prepared_model import Reference
from engine.motion.learning.trainer import InlineTrainer
from engine.motion.pipeline import LearnedInPass, Pipeline
from engine.motion.settings import PipelineSettings
from engine.offline.first_reference import first_frames
from engine.offline.mesh_files import MeshOptions, MeshSaver
from engine.offline.offline_gate import OfflineGate
from engine.offline.result_files import BreathTable, MotionTable, OfflineSummary, Results
from engine.offline.segments import SegmentSummary
from engine.offline.smoothing import MotionSmoother

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
    is_single_pass: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class _Run:
    """What both passes have in common."""

    source: DepthSource
    out: Path
    settings: PipelineSettings
    limits: GateLimits | None
    meshes: MeshOptions
    on_frame: Callable[[Measurement], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pass:
    """What a pass found.

    Attributes
    ----------
    live_from
        Index of the first frame that a live session measures; None if there is none.
    damage
        Why the recording was not read to its end; None if it was.
    segments
        Stretches in which patient, couch and camera stay where they are.
    """

    results: Results
    meshes: tuple[str, ...]
    live_from: int | None
    damage: str | None
    segments: tuple[SegmentSummary, ...]


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
    is_single_pass: bool = False,
    on_pass: Callable[[int], None] | None = None,
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
        Called with each measurement, in both passes.
    model
        A stored model to use instead of learning one; it is compared with the patient of this recording, and the first
        measured frame is the reference.
    origin
        Origin of a model fitted here, stored in ``model.npz``.
    is_single_pass
        Write what a live session measures: nothing before it has a model.
    on_pass
        Called at the beginning of each pass with its number, 1 or 2.

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
        pipeline.learner.models.resume(model)
    out.mkdir(parents=True, exist_ok=True)
    run = _Run(
        source=source,
        out=out,
        settings=settings,
        limits=limits,
        meshes=meshes or MeshOptions(),
        on_frame=on_frame or _do_nothing,
    )
    begin = on_pass or _do_nothing
    begin(1)
    found, learner = _first_pass(run, pipeline, is_single=is_single_pass), pipeline.learner
    if not is_single_pass:
        live_from = found.live_from
        del found  # its results, which the second pass makes again
        begin(2)
        found, learner = _second_pass(run, calibration, pipeline.learned_in_pass(), live_from)
    is_split_marked = pipeline.marked_split is not None
    passes = 1 if is_single_pass else 2
    return _saved(run, learner, found, origin, is_split_marked=is_split_marked, passes=passes)


def _first_pass(run: _Run, pipeline: Pipeline, *, is_single: bool) -> _Pass:
    """Measure as a live session does; its tables are kept if they are all there will be."""

    def is_kept() -> bool:
        return is_single or pipeline.learner.status.model is None

    if not is_single and pipeline.learner.status.model is None:
        pipeline.learner.refits.keep_recording()
    found = _run_pass(run if is_single else replace(run, meshes=MeshOptions()), pipeline, is_kept, 0)
    if pipeline.learner.status.model is None:
        found.results.save(run.out / "regions.npz")
        frames, reason = found.results.frames, _reason_without_model(found.results)
        msg = f"{frames} frames were not enough to learn a motion model: {reason}"
        raise ModelError(msg)
    return found


def _second_pass(
    run: _Run, calibration: Calibration, learned: LearnedInPass, live_from: int | None
) -> tuple[_Pass, Learner]:
    """Measure every frame with what was learned; the first of them is the reference."""
    settings = replace(run.settings, training=replace(run.settings.training, retrain_interval_s=0.0, refit_until_s=0.0))

    def prepared(reference: Reference | None) -> Pipeline:
        pipeline = Pipeline(calibration, settings, ManualClock(), InlineTrainer())
        pipeline.measure_again(learned._replace(learned=replace(learned.learned, reference=reference)))
        return pipeline

    pipeline = prepared(_first_reference(run.source, prepared(None)))
    found = _run_pass(run, pipeline, lambda: True, live_from, is_smoothing=True)
    return replace(found, live_from=live_from), pipeline.learner


def _first_reference(source: DepthSource, pipeline: Pipeline) -> Reference | None:
    """Measure the first half second of a recording; return its reference, None if nothing is measured."""
    try:
        with contextlib.closing(_measurements(source, pipeline)) as measured:
            first = first_frames(measurement for _, measurement in measured)
    except RecordingError:
        return None  # the damage is met again, and reported, by the pass itself
    reference = pipeline.learner.learned.reference
    return None if reference is None else first.smoothed(reference)


def _run_pass(
    run: _Run, pipeline: Pipeline, is_kept: Callable[[], bool], live_from: int | None, *, is_smoothing: bool = False
) -> _Pass:
    """Measure all frames; ``live_from`` is the first one that the gate may judge, None if there is none."""
    results, saver, gate = (
        Results(run.settings),
        MeshSaver(run.out, run.meshes),
        OfflineGate(run.limits, pipeline.learner.learned_ranges),
    )
    first_measured = None
    with _tables(run.out, run.settings, is_kept) as (table, breaths):

        def write(measurement: Measurement, decided: Gate) -> None:
            table.write(measurement, decided)
            breaths.write(measurement)
            results.add(measurement)
            saver.save(measurement)
            run.on_frame(measurement)

        smoother = MotionSmoother(write, is_smoothing=is_smoothing)

        def decide(frame: RgbdFrame, measurement: Measurement) -> None:
            nonlocal first_measured
            learner, index = pipeline.learner, measurement.frame_index
            if live_from is None or index < live_from:
                decided = gate.hold_untrained(frame, measurement)
            else:
                decided = gate.decide(frame, measurement, learner.status, learner.take_notices())
            learner.keep_model(is_kept=gate.is_armed)
            if first_measured is None and measurement.state is MeasurementState.MEASURING:
                first_measured = index
            smoother.add(measurement, decided)

        damage = _measure_frames(run.source, pipeline, decide)
        smoother.finish()
    return _Pass(
        results=results,
        meshes=tuple(saver.saved),
        live_from=first_measured,
        damage=damage,
        segments=table.segments.summary(),
    )


def _saved(
    run: _Run, learner: Learner, found: _Pass, origin: ModelOrigin | None, *, is_split_marked: bool, passes: int
) -> OfflineSummary:
    """Write regions, summary and the model that measured."""
    status = learner.status
    fitted = status.model
    assert fitted is not None, "a pass without a model has raised"
    found.results.save(run.out / "regions.npz")
    save_model(fitted if origin is None else fitted.from_origin(origin), run.out / "model.npz")
    summary = replace(
        found.results.summary(),
        training_frames=fitted.training_frames,
        cycles=fitted.cycles,
        is_split_marked=is_split_marked,
        meshes=found.meshes,
        shortcoming=status.model_shortcoming,
        damage=found.damage,
        passes=passes,
        live_from_frame=found.live_from,
        segments=found.segments,
        reference_uncertainty_mm=_known(learner.learned.reference),
        **_duty(run.limits, learner),
    )
    summary.save(run.out / "motion_summary.json")
    return summary


def _known(reference: Reference | None) -> float | None:
    uncertainty_mm = math.nan if reference is None else reference.uncertainty_mm
    return round(uncertainty_mm, 4) if math.isfinite(uncertainty_mm) else None


def _duty(limits: GateLimits | None, learner: Learner) -> dict[str, Any]:
    """Return the window's predicted duty cycle, and why a session would refuse to arm with it."""
    if limits is None:
        return {}
    levels = learner.learned_levels(limits.window.choices)
    try:
        refuse_never_left(limits, levels)
        refuse_hold_in_free_breath(limits, levels)
    except (InvalidValueError, CommandRefusedError) as error:
        return {"predicted_duty_percent": duty_percent(limits.window, levels), "duty_refusal": str(error)}
    return {"predicted_duty_percent": duty_percent(limits.window, levels)}


def _do_nothing(_value: object) -> None:
    """Do nothing: the default of ``on_frame`` and ``on_pass``."""


@contextmanager
def _tables(
    out: Path, settings: PipelineSettings, is_kept: Callable[[], bool]
) -> Iterator[tuple[MotionTable, BreathTable]]:
    """Yield the tables of motion.csv and breathing.csv.

    The files appear at the end of the block, if it succeeds and they are kept.
    """
    partial, breaths_partial = out / "motion.csv.partial", out / "breathing.csv.partial"
    try:
        with partial.open("w", newline="") as file, breaths_partial.open("w", newline="") as breaths_file:
            yield MotionTable(file, settings), BreathTable(breaths_file)
        if is_kept():
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


def _measurements(source: DepthSource, pipeline: Pipeline) -> Generator[tuple[RgbdFrame, Measurement]]:
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
