"""``tidegate qa``: daily, monthly and annual QA; what is kept of it, and the baseline it is held against."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from service.cli.terminal import refused, say

if TYPE_CHECKING:
    from service.cli.qa_run import RunOptions

qa = typer.Typer(
    name="qa",
    help="QA: camera, motion, gate timing and beam line against the site's bounds; kept for good, printed as PDF.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
)

Operator = Annotated[str, typer.Option(help="Who does it; kept and audited.", show_default=False)]
CODES = "Exit code: 0 passed, 3 passed with a warning, 1 failed or could not be done, 2 refused."
MONTHLY = f"""All of daily, warm-up, drift, flatness, motion against a phantom, and gate timing by the sine method.

{CODES}
"""
ANNUAL = f"""All of monthly, and the gate's delays told apart: on and off.

{CODES}
"""
DataFolder = Annotated[Path | None, typer.Option(help="The service's data folder, as given to `tidegate serve`.")]
Plate = Annotated[
    str | None, typer.Option(metavar="SOURCE", help="Recording of a flat plate; or device, or device:ADDRESS, live.")
]
Phantom = Annotated[
    str | None, typer.Option(metavar="SOURCE", help="Recording of the moving phantom; or device, or device:ADDRESS.")
]
Trace = Annotated[
    Path | None, typer.Option(help="What the phantom was told: CSV time_s,position_mm, or a robot's file.")
]
Window = Annotated[
    str | None,
    typer.Option(
        metavar="LOWER:UPPER", help="Gating window in the trace's positions, in mm; one edge beyond its reach."
    ),
]
Calibration = Annotated[
    Path | None, typer.Option(help="The camera's calibration; calibration.json beside the plate's recording if not.")
]
Part = Annotated[float, typer.Option(help="Share of the picture's width and height that the plate fills.")]
Seconds = Annotated[
    float | None, typer.Option(help="Read no more of each source than this, in seconds.", show_default=False)
]
StartsUs = Annotated[
    int | None, typer.Option(help="Device time of the trace's time 0, in microseconds; the first frame's if not.")
]
Repeats = Annotated[int, typer.Option(help="How often each drill of the beam line is done.")]
Pulse = Annotated[float, typer.Option(help="Length of each lease in the drills, in ms.")]
IsSafe = Annotated[
    bool, typer.Option("--yes-the-beam-is-safe", help="Nobody is in the room and the accelerator is made safe.")
]
NoteText = Annotated[str, typer.Option(help="Kept with the run and printed.")]
Out = Annotated[Path | None, typer.Option(help="Where to put the report (PDF).")]
IsSimulated = Annotated[
    bool, typer.Option("--simulated", help="A virtual plate, phantom and line, for demonstration: counts for nothing.")
]
Seed = Annotated[int, typer.Option(help="With --simulated: same seed, same pictures.")]
FaultOffset = Annotated[float, typer.Option(help="With --simulated: everything is so much nearer, in mm.")]
FaultDelay = Annotated[float, typer.Option(help="With --simulated: pictures are so late, in ms.")]
FaultDuty = Annotated[
    float, typer.Option(help="With --simulated: the beam is on for so much more of a cycle, in per cent.")
]


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
    """Camera distance and angle, noise, and the beam line's drills. PERMITS THE BEAM of a real line.

    Exit code: 0 passed, 3 passed with a warning, 1 failed or could not be done, 2 refused.
    """
    from service.cli.qa_run import RunOptions

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
    """Make the command of a kind that asks for a phantom."""

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
        from service.cli.qa_run import RunOptions

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


@qa.command("list")
def list_runs(
    *,
    limit: Annotated[int, typer.Option(help="Most runs.", min=1, max=500)] = 20,
    data: DataFolder = None,
) -> None:
    """List the newest runs; also beside a running service."""
    from service.cli.qa_kept import print_runs

    print_runs(data, limit)


@qa.command()
def trend(
    check: Annotated[str, typer.Argument(help="A check's code, e.g. camera_distance_mm; `qa checks` lists them.")],
    *,
    limit: Annotated[int, typer.Option(help="Most runs.", min=1, max=500)] = 30,
    data: DataFolder = None,
) -> None:
    """Print a check over the newest runs, oldest first; also beside a running service."""
    from service.cli.qa_kept import print_trend

    print_trend(data, check, limit)


@qa.command()
def checks(*, data: DataFolder = None) -> None:
    """List what is checked, in which runs, by which bounds of this site, and where they come from."""
    from service.cli.qa_kept import print_checks

    print_checks(data)


@qa.command()
def report(
    run_id: Annotated[str, typer.Argument(metavar="ID", help="A run's id, or its first signs; `qa list` tells it.")],
    out: Annotated[Path, typer.Option(help="Where to put the report (PDF).", show_default=False)],
    *,
    data: DataFolder = None,
) -> None:
    """Print a finished run as PDF; also beside a running service."""
    from service.cli.qa_kept import write_report

    write_report(data, run_id, out)


@qa.command()
def baseline(
    *,
    operator: Annotated[str | None, typer.Option(help="Who fixes it; needed to change it.", show_default=False)] = None,
    reason: Annotated[str | None, typer.Option(help="Why; kept and audited.", show_default=False)] = None,
    camera_distance_mm: Annotated[float | None, typer.Option(show_default=False)] = None,
    camera_tilt_x_deg: Annotated[float | None, typer.Option(show_default=False)] = None,
    camera_tilt_y_deg: Annotated[float | None, typer.Option(show_default=False)] = None,
    from_run: Annotated[
        str | None, typer.Option(metavar="ID", help="Take over what this finished run measured.", show_default=False)
    ] = None,
    data: DataFolder = None,
) -> None:
    """Print what the camera's place should read; with values or --from-run, fix it anew."""
    from service.cli.qa_kept import fix_baseline, print_baseline

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
        raise refused("qa baseline", "a baseline is fixed by a named person for a reason: give --operator and --reason")
    fix_baseline(data, given, from_run, operator=operator, reason=reason)


class _Code:
    """Exit codes of a run."""

    FAILED, WARNED, CANCELLED = 1, 3, 130


def _do(options: "RunOptions") -> None:
    """Do a run and leave with the code of its verdict."""
    from service.cli.qa_run import do_run

    try:
        verdict = do_run(options)
    except KeyboardInterrupt:
        say(f"tidegate qa {options.kind}: cancelled; the beam line is held", "red")
        raise typer.Exit(_Code.CANCELLED) from None
    if verdict != "pass":
        raise typer.Exit(_Code.WARNED if verdict == "warn" else _Code.FAILED)
