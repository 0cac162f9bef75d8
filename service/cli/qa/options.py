"""Options of the runs of `tidegate qa`, each once: a field with its default is an option of the command line."""

import inspect
from collections.abc import Callable, Collection
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

WITH_PHANTOM = frozenset({"phantom", "trace", "window", "starts_us", "fault_delay_ms", "fault_duty_percent"})
"""Options that a daily run does not have."""
Operator = Annotated[
    str, typer.Option(help="Name of the operator; stored and written to the audit log.", show_default=False)
]
DataFolder = Annotated[Path | None, typer.Option(help="Data folder of the service; TIDEGATE_DATA_DIR by default.")]
IsSafe = Annotated[
    bool,
    typer.Option(
        "--yes-the-beam-is-safe", help="Confirm that the room is empty and the accelerator is in a safe state."
    ),
]
NoteText = Annotated[str, typer.Option(help="Remark, stored with the run and printed in the report.")]
Out = Annotated[Path | None, typer.Option(help="File for the report (PDF).")]


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """The options of a run."""

    kind: str
    operator: Operator
    plate: Annotated[
        str | None,
        typer.Option(metavar="SOURCE", help="Recording of a flat plate; device or device:ADDRESS for a live camera."),
    ] = None
    phantom: Annotated[
        str | None,
        typer.Option(
            metavar="SOURCE", help="Recording of the moving phantom; device or device:ADDRESS for a live camera."
        ),
    ] = None
    trace: Annotated[
        Path | None, typer.Option(help="Programmed motion of the phantom: CSV time_s,position_mm, or a robot's file.")
    ] = None
    window: Annotated[
        str | None,
        typer.Option(
            metavar="LOWER:UPPER", help="Gating window in positions of the trace, with one edge outside its range [mm]."
        ),
    ] = None
    calibration: Annotated[
        Path | None,
        typer.Option(help="Calibration of the camera; calibration.json beside the recording of the plate by default."),
    ] = None
    part: Annotated[
        float, typer.Option(help="Share of the picture's width and height that the plate fills, 0 to 1.")
    ] = 0.5
    seconds: Annotated[
        float | None, typer.Option(help="Longest part of each source to read [s].", show_default=False)
    ] = None
    starts_us: Annotated[
        int | None, typer.Option(help="Device time of the trace's time 0; that of the first frame by default [us].")
    ] = None
    repeats: Annotated[int, typer.Option(help="Number of repeats of each beam line test.")] = 20
    pulse: Annotated[float, typer.Option(help="Length of each lease in the beam line tests [ms].")] = 200.0
    is_safe: IsSafe = False
    note: NoteText = ""
    out: Out = None
    data: DataFolder = None
    is_simulated: Annotated[
        bool,
        typer.Option(
            "--simulated", help="Use a virtual plate, phantom and beam line, for demonstration; not a QA result."
        ),
    ] = False
    seed: Annotated[
        int,
        typer.Option(
            help="With --simulated: seed of the pictures; the same seed gives the same ones on one processor."
        ),
    ] = 1
    fault_offset_mm: Annotated[
        float, typer.Option(help="With --simulated: shift of all depths towards the camera [mm].")
    ] = 0.0
    fault_delay_ms: Annotated[float, typer.Option(help="With --simulated: delay of the pictures [ms].")] = 0.0
    fault_duty_percent: Annotated[
        float, typer.Option(help="With --simulated: additional beam-on time per cycle [%].")
    ] = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LatencyOptions:
    """The options of a measurement of the latency."""

    operator: Operator
    camera: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Address of the camera; the first one by default.")
    ] = None
    output_delay_ms: Annotated[
        float | None,
        typer.Option(
            help="Longest time from the output's read-back to the light, 0 to 50; a relay takes up to 15 [ms].",
            show_default=False,
        ),
    ] = None
    seconds: Annotated[float, typer.Option(help="Time for which frames are read, 30 to 120 [s].")] = 60.0
    is_safe: IsSafe = False
    note: NoteText = ""
    out: Out = None
    data: DataFolder = None
    is_simulated: Annotated[
        bool,
        typer.Option("--simulated", help="Use a virtual camera and light, for demonstration; not a QA result."),
    ] = False
    seed: Annotated[
        int | None, typer.Option(help="Seed of the light's pattern; random by default.", min=0, max=2**31 - 1)
    ] = None
    fault_delay_ms: Annotated[float, typer.Option(help="With --simulated: latency of the virtual camera [ms].")] = 40.0


OptionsT = TypeVar("OptionsT", RunOptions, LatencyOptions)


def command_of(
    options: type[OptionsT],
    words: str,
    run: Callable[[OptionsT], None],
    *,
    without: Collection[str] = (),
    **fixed: Any,  # noqa: ANN401 - of the type of its field
) -> Callable[..., None]:
    """Return a command with the options of a dataclass; those ``without`` keep their defaults, ``fixed`` are given."""

    def command(**given: Any) -> None:  # noqa: ANN401 - what the fields say
        run(options(**given, **fixed))

    shown = [one for one in fields(options) if one.name not in without and one.name not in fixed]
    command.__doc__ = words
    command.__annotations__ = {one.name: one.type for one in shown}
    command.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [
            inspect.Parameter(
                one.name,
                inspect.Parameter.KEYWORD_ONLY,
                default=inspect.Parameter.empty if one.default is MISSING else one.default,
                annotation=one.type,
            )
            for one in shown
        ]
    )
    return command
