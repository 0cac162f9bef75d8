"""``tidegate qa``: daily, monthly and annual QA; what is kept of it, and the baseline it is held against."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from service.cli.command_group import command_group
from service.cli.terminal import refused, say

if TYPE_CHECKING:
    from service.cli.qa.run import RunOptions

qa = command_group("qa", "Run QA of camera, motion, gate timing and beam line, and print its results.")

Operator = Annotated[
    str, typer.Option(help="Name of the operator; stored and written to the audit log.", show_default=False)
]
CODES = "Exit code: 0 passed, 3 passed with a warning, 1 failed or not completed, 2 refused."
MONTHLY = f"""All of daily, warm-up, drift, flatness, motion against a phantom, and gate timing by the sine method.

{CODES}
"""
ANNUAL = f"""All of monthly, and the separate on and off delays of the gate.

{CODES}
"""
DataFolder = Annotated[Path | None, typer.Option(help="Data folder of the service; TIDEGATE_DATA_DIR by default.")]
Plate = Annotated[
    str | None,
    typer.Option(metavar="SOURCE", help="Recording of a flat plate; device or device:ADDRESS for a live camera."),
]
Phantom = Annotated[
    str | None,
    typer.Option(metavar="SOURCE", help="Recording of the moving phantom; device or device:ADDRESS for a live camera."),
]
Trace = Annotated[
    Path | None, typer.Option(help="Programmed motion of the phantom: CSV time_s,position_mm, or a robot's file.")
]
Window = Annotated[
    str | None,
    typer.Option(
        metavar="LOWER:UPPER", help="Gating window in positions of the trace, with one edge outside its range [mm]."
    ),
]
Calibration = Annotated[
    Path | None,
    typer.Option(help="Calibration of the camera; calibration.json beside the recording of the plate by default."),
]
Part = Annotated[float, typer.Option(help="Share of the picture's width and height that the plate fills, 0 to 1.")]
Seconds = Annotated[float | None, typer.Option(help="Longest part of each source to read [s].", show_default=False)]
StartsUs = Annotated[
    int | None, typer.Option(help="Device time of the trace's time 0; that of the first frame by default [us].")
]
Repeats = Annotated[int, typer.Option(help="Number of repeats of each beam line test.")]
Pulse = Annotated[float, typer.Option(help="Length of each lease in the beam line tests [ms].")]
IsSafe = Annotated[
    bool,
    typer.Option(
        "--yes-the-beam-is-safe", help="Confirm that the room is empty and the accelerator is in a safe state."
    ),
]
NoteText = Annotated[str, typer.Option(help="Remark, stored with the run and printed in the report.")]
Out = Annotated[Path | None, typer.Option(help="File for the report (PDF).")]
IsSimulated = Annotated[
    bool,
    typer.Option("--simulated", help="Use a virtual plate, phantom and beam line, for demonstration; not a QA result."),
]
Seed = Annotated[
    int,
    typer.Option(help="With --simulated: seed of the pictures; the same seed gives the same ones on one processor."),
]
FaultOffset = Annotated[float, typer.Option(help="With --simulated: shift of all depths towards the camera [mm].")]
FaultDelay = Annotated[float, typer.Option(help="With --simulated: delay of the pictures [ms].")]
FaultDuty = Annotated[float, typer.Option(help="With --simulated: additional beam-on time per cycle [%].")]


@qa.command()
def daily(
    operator: Operator,
    *,
    plate: Plate = None,
    calibration: Calibration = None,
    part: Part = 0.5,
    seconds: Seconds = None,
    repeats: Repeats = 20,
    pulse: Pulse = 200.0,
    is_safe: IsSafe = False,
    note: NoteText = "",
    out: Out = None,
    data: DataFolder = None,
    is_simulated: IsSimulated = False,
    seed: Seed = 1,
    fault_offset_mm: FaultOffset = 0.0,
) -> None:
    """Check camera distance, angle and noise, and test the beam line. PERMITS THE BEAM of a real line.

    Exit code: 0 passed, 3 passed with a warning, 1 failed or not completed, 2 refused.
    """
    from service.cli.qa.run import RunOptions

    options = RunOptions(
        kind="daily",
        operator=operator,
        plate=plate,
        calibration=calibration,
        part=part,
        seconds=seconds,
        repeats=repeats,
        pulse_ms=pulse,
        is_safe=is_safe,
        note=note,
        out=out,
        data=data,
        is_simulated=is_simulated,
        seed=seed,
        fault_offset_mm=fault_offset_mm,
    )
    _do(options)


def _with_phantom(kind: Literal["monthly", "annual"], words: str) -> Callable[..., None]:
    """Return the command of a kind of run that needs a phantom."""

    def command(
        operator: Operator,
        *,
        plate: Plate = None,
        phantom: Phantom = None,
        trace: Trace = None,
        window: Window = None,
        calibration: Calibration = None,
        part: Part = 0.5,
        seconds: Seconds = None,
        starts_us: StartsUs = None,
        repeats: Repeats = 20,
        pulse: Pulse = 200.0,
        is_safe: IsSafe = False,
        note: NoteText = "",
        out: Out = None,
        data: DataFolder = None,
        is_simulated: IsSimulated = False,
        seed: Seed = 1,
        fault_offset_mm: FaultOffset = 0.0,
        fault_delay_ms: FaultDelay = 0.0,
        fault_duty_percent: FaultDuty = 0.0,
    ) -> None:
        from service.cli.qa.run import RunOptions

        options = RunOptions(
            kind=kind,
            operator=operator,
            plate=plate,
            phantom=phantom,
            trace=trace,
            window=window,
            calibration=calibration,
            part=part,
            seconds=seconds,
            starts_us=starts_us,
            repeats=repeats,
            pulse_ms=pulse,
            is_safe=is_safe,
            note=note,
            out=out,
            data=data,
            is_simulated=is_simulated,
            seed=seed,
            fault_offset_mm=fault_offset_mm,
            fault_delay_ms=fault_delay_ms,
            fault_duty_percent=fault_duty_percent,
        )
        _do(options)

    command.__doc__ = words
    return command


qa.command("monthly")(_with_phantom("monthly", MONTHLY))
qa.command("annual")(_with_phantom("annual", ANNUAL))


@qa.command()
def latency(
    operator: Operator,
    *,
    camera: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Address of the camera; the first one by default.")
    ] = None,
    output_delay_ms: Annotated[
        float | None,
        typer.Option(
            help="Longest time from the output's read-back to the light, 0 to 50; a relay takes up to 15 [ms].",
            show_default=False,
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(help="Time for which frames are read, 30 to 120 [s].")] = 60.0,
    is_safe: IsSafe = False,
    note: NoteText = "",
    out: Out = None,
    data: DataFolder = None,
    is_simulated: Annotated[
        bool,
        typer.Option("--simulated", help="Use a virtual camera and light, for demonstration; not a QA result."),
    ] = False,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the light's pattern; random by default.", min=0, max=2**31 - 1)
    ] = None,
    fault_delay_ms: Annotated[float, typer.Option(help="With --simulated: latency of the virtual camera [ms].")] = 40.0,
) -> None:
    """Measure a camera's latency, by an LED on the beam line's output. PERMITS THE BEAM of a real line.

    Clinical mode arms only with a camera whose latency was measured. No session may run. Exit code: 0 passed, 3 passed
    with a warning, 1 failed or not completed, 2 refused.
    """
    from service.cli.qa.latency import LatencyOptions, measure_camera

    options = LatencyOptions(
        operator=operator,
        camera=camera,
        output_delay_ms=output_delay_ms,
        seconds=seconds,
        is_safe=is_safe,
        note=note,
        out=out,
        data=data,
        is_simulated=is_simulated,
        seed=seed,
        fault_delay_ms=fault_delay_ms,
    )
    _exit_with("latency", lambda: measure_camera(options))


@qa.command("cameras")
def list_cameras(*, data: DataFolder = None) -> None:
    """List the newest measured latency of each camera and mode; the service may be running."""
    from service.cli.qa.archive import print_cameras

    print_cameras(data)


@qa.command()
def code(
    operator: Annotated[
        str, typer.Option(help="Name of the physicist who starts the run; as typed at log-in.", show_default=False)
    ],
    *,
    data: DataFolder = None,
) -> None:
    """Display a one-time code at this machine: POST /qa/runs needs it on a real beam line.

    It is valid for five minutes, once, for this person; a new code ends the one before. The service may be running. The
    commands daily, monthly and annual need no code.
    """
    from service.cli.qa.archive import show_code

    show_code(data, operator)


@qa.command("list")
def list_runs(
    *,
    limit: Annotated[int, typer.Option(help="Largest number of runs.", min=1, max=500)] = 20,
    data: DataFolder = None,
) -> None:
    """List the newest runs; the service may be running."""
    from service.cli.qa.archive import print_runs

    print_runs(data, limit)


@qa.command()
def trend(
    check: Annotated[str, typer.Argument(help="Code of a check, e.g. camera_distance_mm; see `tidegate qa checks`.")],
    *,
    limit: Annotated[int, typer.Option(help="Largest number of runs.", min=1, max=500)] = 30,
    data: DataFolder = None,
) -> None:
    """Print the values of a check in the newest runs, oldest first; the service may be running."""
    from service.cli.qa.archive import print_trend

    print_trend(data, check, limit)


@qa.command()
def checks(*, data: DataFolder = None) -> None:
    """List all checks: the runs that include them, the bounds of this site and their sources."""
    from service.cli.qa.archive import print_checks

    print_checks(data)


@qa.command()
def report(
    run_id: Annotated[
        str, typer.Argument(metavar="ID", help="Id of a run, or its first characters; see `tidegate qa list`.")
    ],
    out: Annotated[Path, typer.Option(help="File for the report (PDF).", show_default=False)],
    *,
    data: DataFolder = None,
) -> None:
    """Write the report of a finished run as PDF; the service may be running."""
    from service.cli.qa.archive import write_report

    write_report(data, run_id, out)


@qa.command()
def baseline(
    *,
    operator: Annotated[
        str | None, typer.Option(help="Name of the operator; required for a change.", show_default=False)
    ] = None,
    reason: Annotated[
        str | None, typer.Option(help="Reason of the change; stored and written to the audit log.", show_default=False)
    ] = None,
    camera_distance_mm: Annotated[
        float | None, typer.Option(help="Expected camera distance [mm].", show_default=False)
    ] = None,
    camera_tilt_x_deg: Annotated[
        float | None, typer.Option(help="Expected tilt about x [deg].", show_default=False)
    ] = None,
    camera_tilt_y_deg: Annotated[
        float | None, typer.Option(help="Expected tilt about y [deg].", show_default=False)
    ] = None,
    from_run: Annotated[
        str | None, typer.Option(metavar="ID", help="Use the values of this finished run.", show_default=False)
    ] = None,
    data: DataFolder = None,
) -> None:
    """Print the expected camera distance and angles; set them with values or --from-run."""
    from service.cli.qa.archive import fix_baseline, print_baseline

    values = {
        "camera_distance_mm": camera_distance_mm,
        "camera_tilt_x_deg": camera_tilt_x_deg,
        "camera_tilt_y_deg": camera_tilt_y_deg,
    }
    given = {name: value for name, value in values.items() if value is not None}
    if not given and from_run is None:
        print_baseline(data)
        return
    if operator is None or reason is None:
        raise refused("qa baseline", "a change of the baseline needs --operator and --reason")
    fix_baseline(data, given, from_run, operator=operator, reason=reason)


class _Code:
    """Exit codes of a run."""

    FAILED, WARNED, CANCELLED = 1, 3, 130


def _do(options: "RunOptions") -> None:
    """Run and exit with the code of the verdict."""
    from service.cli.qa.run import do_run

    _exit_with(options.kind, lambda: do_run(options))


def _exit_with(kind: str, measured: Callable[[], str]) -> None:
    try:
        verdict = measured()
    except KeyboardInterrupt:
        say(f"tidegate qa {kind}: cancelled; the beam is held", "red")
        raise typer.Exit(_Code.CANCELLED) from None
    if verdict != "pass":
        raise typer.Exit(_Code.WARNED if verdict == "warn" else _Code.FAILED)
