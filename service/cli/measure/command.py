"""``tidegate measure``: motion in mm from one or more recordings."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from engine import __version__
from engine.calibration import load_calibration
from engine.capture import OniFileSource, describe
from engine.core.clock import MonotonicClock
from engine.core.errors import RecordingError, TidegateError
from engine.core.frames import Measurement
from engine.core.motion_model import MAX_TEXT, ModelOrigin, MotionModel, check_patient
from engine.gating import DWELL_MS, HEAD_DIRECTION_UNKNOWN, GateLimits
from engine.motion import PipelineSettings, TrainingSettings, load_model
from engine.offline import FileTask, OfflineSummary, SegmentSummary, measure_recording
from service.cli.cluster.options import (
    AuthorityFile,
    CertificateFile,
    KeyFile,
    SchedulerAddress,
    SchedulerOptions,
    scheduler_options,
)
from service.cli.measure import options
from service.cli.terminal import BAD_INPUT, frame_bar, refused, say

MIRRORED_CALIBRATION = "its calibration has to be of unmirrored pictures (tidegate calibrate convert --mirrored)"
SOFTWARE = f"tidegate {__version__}"


# Stored motion models: read one, and the origin that is stored with a new one.
def stored_model(path: Path, patient: str | None) -> MotionModel:
    """Read a model and refuse that of another patient; without ``patient``, print that this was not checked."""
    model = load_model(path)
    if patient is None:
        say("Note: it was not checked that this model is this patient's; give --patient to check it", "yellow")
    else:
        check_patient(model.provenance.origin, patient)
    return model


def model_origin(recording: Path, patient: str | None) -> ModelOrigin:
    """Return the origin of a model trained on a recording.

    Without the time of day: on one processor the same recording gives the same file, byte for byte.
    """
    return ModelOrigin(patient=patient or "", source=recording.name[-MAX_TEXT:], software=SOFTWARE)


def measure(
    recordings: Annotated[list[Path], typer.Argument(help="One or more .oni recordings.", metavar="REC.oni...")],
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for motion.csv, breathing.csv, regions.npz, motion_summary.json and model.npz; with several "
            "recordings it contains a folder per recording and summary.csv."
        ),
    ],
    calibration: Annotated[
        list[Path] | None,
        typer.Option(
            help="Calibration of the cameras (tidegate.calibration/1): one for all recordings, or one each in their "
            "order; calibration.json beside each recording by default."
        ),
    ] = None,
    point: Annotated[
        list[str] | None, typer.Option(help="ROW,COL of a point of the 350 x 200 grid to report; repeatable.")
    ] = None,
    region: Annotated[
        list[str] | None,
        typer.Option(help="NAME=ROW,COL;ROW,COL;...: polygon on the grid to report under this name; repeatable."),
    ] = None,
    regions: Annotated[Path | None, typer.Option(help="File with more regions (tidegate.regions/1).")] = None,
    split: Annotated[
        str | None,
        typer.Option(
            help="ROW,ROW: lower end of the thorax at the right and left edge of the grid; 174.5,174.5 by default."
        ),
    ] = None,
    extra_markers: Annotated[
        bool,
        typer.Option(
            "--extra-markers", help="Two extra stickers at the costal margin mark the lower end of the thorax."
        ),
    ] = False,
    cell: Annotated[int, typer.Option(help="Side of a cell of the regions [grid px].")] = 25,
    components: Annotated[int, typer.Option(help="Largest number of principal components of the motion model.")] = 6,
    window: Annotated[
        str | None,
        typer.Option(
            help="SIGNAL:LOWER:UPPER, in mm or for volume in l, e.g. whole:-1:3: add the decisions that the gate would "
            "have made. SIGNAL is whole, thorax, abdomen, volume, a --point as pROW_COL, or the name of a --region."
        ),
    ] = None,
    head: Annotated[
        str,
        typer.Option(
            help="Side of the picture at which the patient's head lies: top, bottom, left or right. auto is top, or "
            "left if the longer sides of the markers are horizontal; a --window on a part of the patient is then held."
        ),
    ] = "auto",
    mesh: Annotated[
        str | None, typer.Option(help="FRAME,FRAME,...: write the surface in these frames to mesh_FRAME.ply.")
    ] = None,
    mesh_format: Annotated[str, typer.Option(help="ply (binary) or obj.")] = "ply",
    model: Annotated[
        Path | None,
        typer.Option(
            help="Stored model.npz to measure with instead of training one; refused for another calibration, another "
            "patient, or a position too far from that of the training."
        ),
    ] = None,
    patient: Annotated[
        str | None, typer.Option(help="Pseudonymous patient reference, stored with the model; never a name.")
    ] = None,
    single_pass: Annotated[
        bool,
        typer.Option(
            "--single-pass",
            help="Write what a live session measures: nothing before it has learned the model. By default every frame "
            "is measured with that model, in a second pass.",
        ),
    ] = False,
    jobs: Annotated[int, typer.Option(help="Number of recordings measured in parallel; 0 is one per core.")] = 0,
    scheduler: SchedulerAddress = None,
    tls_ca: AuthorityFile = None,
    tls_cert: CertificateFile = None,
    tls_key: KeyFile = None,
) -> None:
    """Measure the breathing motion in every frame of one or more recordings.

    Writes motion.csv and breathing.csv (one row per depth frame), regions.npz, motion_summary.json and model.npz.
    Motion is in mm, positive towards the camera. Recordings are measured independently: one that fails does not stop
    the others.
    """
    try:
        side = options.head_direction(head)
        settings = PipelineSettings(
            cell_px=cell,
            points=tuple(options.point(text) for text in point or []),
            named=options.regions(region or [], regions),
            split=options.split(split),
            extra_markers=extra_markers,
            superior_px=None if side is None else side.superior_px,
            training=TrainingSettings(components=components),
        )
        stored = None if model is None else stored_model(model, patient)
        tasks = [
            FileTask(
                recording=recording,
                calibration=cameras,
                out=folder,
                settings=settings,
                limits=None
                if window is None
                else GateLimits(
                    window=options.window(window, settings.points, settings.named),
                    dwell_ms=DWELL_MS,
                    head_direction=side,
                ),
                meshes=options.meshes(mesh, mesh_format),
                model=stored,
                origin=model_origin(recording, patient),
                is_single_pass=single_pass,
            )
            for recording, cameras, folder in zip(
                recordings,
                options.calibrations(recordings, calibration or []),
                [out] if len(recordings) == 1 else options.folders(recordings, out),
                strict=True,
            )
        ]
        cluster = scheduler_options(scheduler, tls_ca, tls_cert, tls_key)
        processes = options.check_jobs(jobs, len(tasks), has_scheduler=cluster is not None)
        if len(tasks) > 1:
            _measure_many(tasks, processes, cluster, out)
        elif cluster is not None:
            _print_summary(_measure_elsewhere(tasks[0], cluster), tasks[0])
        else:
            _print_summary(_measure(tasks[0], is_calibration_given=bool(calibration)), tasks[0])
    except TidegateError as error:
        raise refused("measure", error) from error
    except OSError as error:
        raise refused("measure", f"{out} cannot be written ({error.strerror or error})") from error


def _measure(task: FileTask, *, is_calibration_given: bool) -> OfflineSummary:
    """Measure one recording in this process."""
    stored = describe(task.recording)
    if not is_calibration_given:
        say(f"Calibration: {task.calibration}")
    cameras = load_calibration(task.calibration)
    if stored.impossible_times is not None:
        raise RecordingError(f"{task.recording.name}: its times are impossible: {stored.impossible_times}")
    if stored.mirrored is not None:
        say(f"{task.recording.name}: {stored.mirrored} stored mirrored, turned round; {MIRRORED_CALIBRATION}")
    if cameras.serial and stored.serial and cameras.serial != stored.serial:
        say(f"{task.recording.name}: of camera {stored.serial}, and the calibration is of {cameras.serial}")
    total = stored.depth_frames
    with frame_bar() as progress:
        shown = progress.add_task("training", total=total)
        words = ""

        def begin(number: int) -> None:
            nonlocal words
            words = "" if task.is_single_pass else f"pass {number} of 2: "

        def show(measurement: Measurement) -> None:
            if measurement.frame_index % 10 == 0:
                description = f"{words}{measurement.state.value}"
                progress.update(shown, completed=measurement.frame_index + 1, description=description)

        summary = measure_recording(
            OniFileSource(task.recording, clock=MonotonicClock()),
            cameras,
            task.out,
            settings=task.settings,
            limits=task.limits,
            meshes=task.meshes,
            model=task.model,
            origin=task.origin,
            on_frame=show,
            is_single_pass=task.is_single_pass,
            on_pass=begin,
        )
        progress.update(shown, completed=summary.frames, description="done")
    return summary


def _measure_elsewhere(task: FileTask, cluster: SchedulerOptions) -> OfflineSummary:
    """Measure one recording on a cluster."""
    from service.cli.cluster.recordings import measure_on_cluster
    from service.cli.measure.many import measure_with_bar

    [outcome] = measure_with_bar([task], partial(measure_on_cluster, cluster, task.out))
    if outcome.summary is None:
        raise refused("measure", outcome.error)
    return outcome.summary


def _measure_many(tasks: list[FileTask], processes: int, cluster: SchedulerOptions | None, out: Path) -> None:
    from service.cli.measure.many import MeasureAll, measure_many

    measure_all: MeasureAll
    if cluster is None:
        from engine.offline import measure_files

        measure_all = partial(measure_files, processes)
    else:
        from service.cli.cluster.recordings import measure_on_cluster

        measure_all = partial(measure_on_cluster, cluster, out)
    if not measure_many(tasks, measure_all, out):
        raise typer.Exit(BAD_INPUT)


def _print_summary(summary: OfflineSummary, task: FileTask) -> None:
    model = f"trained on {summary.training_frames} frames, {summary.cycles} breathing cycles"
    say(
        f"{summary.frames} frames: {summary.in_training} in training ({'stored model, ' * (task.model is not None)}"
        f"{model}), {summary.measured} measured, {summary.lost} lost. The camera dropped {summary.missed_frames} more. "
        f"{_live_from(summary)}{_duty(summary)}Written to {task.out}"
    )
    if summary.reference_uncertainty_mm is not None:
        say(f"The reference adds {summary.reference_uncertainty_mm:.2f} mm to a point's motion (standard uncertainty).")
    for segment in summary.segments if len(summary.segments) > 1 else ():
        say(_segment(segment))
    for note in _notes(summary, task):
        say(f"Note: {note}", "yellow")
    if summary.damage is not None:
        raise refused("measure", summary.damage)


def _segment(segment: SegmentSummary) -> str:
    """Word where a segment lies, why it began, and how the patient lies in it against the first frame."""
    frames = f"Segment {segment.segment}, frames {segment.first_frame} to {segment.last_frame}"
    moved = segment.moved
    if moved is None:
        return f"{frames}: {segment.cause}, nothing measured"
    known = (
        f"{moved[name]:+.1f} {unit} {way}"
        for name, unit, way in (
            ("shift_x_mm", "mm", "to the left"),
            ("shift_y_mm", "mm", "inferior"),
            ("height_mm", "mm", "towards the camera"),
            ("turn_deg", "degrees", "on the couch"),
        )
        if name in moved
    )
    return f"{frames}: {segment.cause}; {', '.join(known)}"


def _live_from(summary: OfflineSummary) -> str:
    if summary.passes == 1 or summary.live_from_frame is None:
        return ""
    return f"A live session would have measured from frame {summary.live_from_frame} on. "


def _duty(summary: OfflineSummary) -> str:
    percent = summary.predicted_duty_percent
    return "" if percent is None else f"Predicted duty cycle of the window: {percent:.0f} %. "


def _notes(summary: OfflineSummary, task: FileTask) -> list[str]:
    """Return what was requested and could not be done."""
    notes = [] if summary.shortcoming is None else [summary.shortcoming]
    if summary.duty_refusal is not None:
        notes.append(f"a session would not be armed with this window: {summary.duty_refusal}")
    if task.limits is not None and task.limits.needs_head_direction and task.limits.head_direction is None:
        notes.append(f"the window is held: {HEAD_DIRECTION_UNKNOWN}; give --head")
    if task.settings.extra_markers and not summary.is_split_marked:
        notes.append("the two extra stickers were not found often enough: the default line ends the thorax")
    requested = 0 if task.meshes is None else len(task.meshes.frames)
    if requested > len(summary.meshes):
        missing = requested - len(summary.meshes)
        notes.append(f"{missing} of {requested} meshes could not be written: their frames were not measured")
    return notes
