"""``tidegate measure``: recordings to motion in millimetres, in batch."""

from pathlib import Path
from typing import Annotated

import typer

from engine.calibration import load_calibration
from engine.capture.oni_file import OniFileSource
from engine.clock import MonotonicClock
from engine.errors import TidegateError
from engine.frames import Measurement
from engine.limits import GateLimits
from engine.motion_files import OfflineSummary
from engine.offline import FileTask, measure_recording
from engine.oni.reader import describe
from engine.pipeline import PipelineSettings
from engine.training import TrainingSettings
from service.cli import measure_options as options
from service.cli.stored_model import model_origin, stored_model
from service.cli.terminal import BAD_INPUT, frame_bar, refused, say


def measure(
    recordings: Annotated[list[Path], typer.Argument(help="One .oni recording or more.", metavar="REC.oni...")],
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for motion.csv, breathing.csv, regions.npz, motion_summary.json and model.npz; with more than "
            "one recording it gets a folder for each, and summary.csv."
        ),
    ],
    calibration: Annotated[
        list[Path] | None,
        typer.Option(
            help="The cameras' calibration (tidegate.calibration/1): one for all, or one for each in their order. "
            "When left out, calibration.json beside each recording."
        ),
    ] = None,
    point: Annotated[
        list[str] | None, typer.Option(help="ROW,COL of the 350 x 200 grid to report singly; repeatable.")
    ] = None,
    region: Annotated[
        list[str] | None,
        typer.Option(help="NAME=ROW,COL;ROW,COL;...: a polygon on the grid to report under its name; repeatable."),
    ] = None,
    regions: Annotated[Path | None, typer.Option(help="More of them from a file (tidegate.regions/1).")] = None,
    split: Annotated[
        str | None,
        typer.Option(help="ROW,ROW: where thorax ends at the patient's right and left edge of the grid; 174.5,174.5."),
    ] = None,
    extra_markers: Annotated[
        bool,
        typer.Option("--extra-markers", help="Two more stickers at the costal margin mark where thorax ends."),
    ] = False,
    cell: Annotated[int, typer.Option(help="Side of a region's cell on the grid [px].")] = 25,
    components: Annotated[int, typer.Option(help="Principal components to keep.")] = 3,
    window: Annotated[
        str | None,
        typer.Option(
            help="SIGNAL:LOWER:UPPER in mm, l for volume, e.g. whole:-1:3: fill in what the gate would have decided. "
            "The signal may also be a --point, as pROW_COL, or a --region, by its name."
        ),
    ] = None,
    head: Annotated[
        str,
        typer.Option(
            help="Where the patient's head is in the picture: up, down, left or right; auto is up, or left where the "
            "markers' longer sides lie across."
        ),
    ] = "auto",
    mesh: Annotated[
        str | None, typer.Option(help="FRAME,FRAME,...: write the surface of these frames as mesh_FRAME.ply.")
    ] = None,
    mesh_format: Annotated[str, typer.Option(help="ply (binary) or obj.")] = "ply",
    model: Annotated[
        Path | None,
        typer.Option(
            help="A model.npz to measure with instead of learning one; refused for another calibration, another "
            "patient, or one who lies too far from where it was learned."
        ),
    ] = None,
    patient: Annotated[
        str | None, typer.Option(help="The clinic's own pseudonymous reference, kept with the model; no name.")
    ] = None,
    jobs: Annotated[int, typer.Option(help="How many recordings at a time; 0 is one a core.")] = 0,
) -> None:
    """Measure recordings: every frame once, as fast as it can be read.

    Writes motion.csv and breathing.csv (one row a depth frame), regions.npz, motion_summary.json and model.npz. Motion
    is in mm, positive towards the camera. Of many recordings each is measured by itself, and one that fails does not
    stop the others.
    """
    try:
        settings = PipelineSettings(
            cell_px=cell,
            points=tuple(options.point(text) for text in point or []),
            named=options.regions(region or [], regions),
            split=options.split(split),
            extra_markers=extra_markers,
            superior_px=options.superior(head),
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
                else GateLimits(window=options.window(window, settings.points, settings.named)),
                meshes=options.meshes(mesh, mesh_format),
                model=stored,
                origin=model_origin(recording, patient),
            )
            for recording, cameras, folder in zip(
                recordings,
                options.calibrations(recordings, calibration or []),
                [out] if len(recordings) == 1 else options.folders(recordings, out),
                strict=True,
            )
        ]
        processes = options.check_jobs(jobs, len(tasks))
        if len(tasks) == 1:
            _tell(_measure(tasks[0], is_calibration_given=bool(calibration)), tasks[0])
        else:
            _measure_many(tasks, processes, out)
    except TidegateError as error:
        raise refused("measure", error) from error
    except OSError as error:
        raise refused("measure", f"{out} cannot be written ({error.strerror or error})") from error


def _measure(task: FileTask, *, is_calibration_given: bool) -> OfflineSummary:
    """Measure a single recording, in this process."""
    if not is_calibration_given:
        say(f"Calibration: {task.calibration}")
    cameras = load_calibration(task.calibration)
    total = describe(task.recording).depth_frames
    with frame_bar() as progress:
        shown = progress.add_task("training", total=total)

        def show(measurement: Measurement) -> None:
            if measurement.frame_index % 10 == 0:
                progress.update(shown, completed=measurement.frame_index + 1, description=measurement.state.value)

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
        )
        progress.update(shown, completed=summary.frames, description="done")
    return summary


def _measure_many(tasks: list[FileTask], processes: int, out: Path) -> None:
    from service.cli.measure_many import measure_many

    if not measure_many(tasks, processes, out):
        raise typer.Exit(BAD_INPUT)


def _tell(summary: OfflineSummary, task: FileTask) -> None:
    say(
        f"{summary.frames} frames: {summary.training_frames} taught the model ({summary.cycles} breathing cycles), "
        f"{summary.measured} measured, {summary.lost} lost by the measurement, {summary.missed_frames} missing in the "
        f"recording. Written to {task.out}"
    )
    for note in _notes(summary, task):
        say(f"Mind: {note}", "yellow")
    if summary.damage is not None:
        raise refused("measure", summary.damage)


def _notes(summary: OfflineSummary, task: FileTask) -> list[str]:
    """Say what was asked for and did not come."""
    notes = [] if summary.shortcoming is None else [summary.shortcoming]
    if task.settings.extra_markers and not summary.is_split_marked:
        notes.append("two more stickers were not seen often enough: thorax ends where it does without them")
    wanted = 0 if task.meshes is None else len(task.meshes.frames)
    if wanted > len(summary.meshes):
        notes.append(f"{wanted - len(summary.meshes)} of {wanted} meshes could not be made: not measured there")
    return notes
