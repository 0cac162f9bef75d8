"""``tidegate qa``: daily, monthly and annual QA; what is kept of it, and the baseline it is held against."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from service.cli.command_group import command_group
from service.cli.qa.options import WITH_PHANTOM, DataFolder, LatencyOptions, RunOptions, command_of
from service.cli.terminal import refused, say

qa = command_group("qa", "Run QA of camera, motion, gate timing and beam line, and print its results.")

CODES = "Exit code: 0 passed, 3 passed with a warning, 1 failed or not completed, 2 refused."
MONTHLY = f"""All of daily, warm-up, drift, flatness, motion against a phantom, and gate timing by the sine method.

{CODES}
"""
ANNUAL = f"""All of monthly, and the separate on and off delays of the gate.

{CODES}
"""
DAILY = f"""Check camera distance, angle and noise, and test the beam line. PERMITS THE BEAM of a real line.

{CODES}
"""
LATENCY = """Measure a camera's latency, by an LED on the beam line's output. PERMITS THE BEAM of a real line.

Clinical mode arms only with a camera whose latency was measured. No session may run. Exit code: 0 passed, 3 passed
with a warning, 1 failed or not completed, 2 refused.
"""
FAILED, WARNED, CANCELLED = 1, 3, 130
"""Exit codes of a run."""


def _exit_with(kind: str, measured: Callable[[], str]) -> None:
    """Measure, and exit with the code of the verdict."""
    try:
        verdict = measured()
    except KeyboardInterrupt:
        say(f"tidegate qa {kind}: cancelled; the beam is held", "red")
        raise typer.Exit(CANCELLED) from None
    if verdict != "pass":
        raise typer.Exit(WARNED if verdict == "warn" else FAILED)


def _do(options: RunOptions) -> None:
    from service.cli.qa.run import do_run

    _exit_with(options.kind, lambda: do_run(options))


def _measure(options: LatencyOptions) -> None:
    from service.cli.qa.latency import measure_camera

    _exit_with("latency", lambda: measure_camera(options))


qa.command("daily")(command_of(RunOptions, DAILY, _do, without=WITH_PHANTOM, kind="daily"))
qa.command("monthly")(command_of(RunOptions, MONTHLY, _do, kind="monthly"))
qa.command("annual")(command_of(RunOptions, ANNUAL, _do, kind="annual"))
qa.command("latency")(command_of(LatencyOptions, LATENCY, _measure))


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
