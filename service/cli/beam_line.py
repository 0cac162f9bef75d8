"""``tidegate beam-line check``: open the configured beam line and measure its response times."""

import threading
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.cli.command_group import command_group
from service.cli.terminal import frame_bar, refused, say

if TYPE_CHECKING:
    from engine.beam import DrilledReceiver, Pulser
    from engine.core.clock import Clock
    from engine.core.errors import TidegateError
    from service.core.settings.settings import Settings
    from service.engine_host.beam_lines import LinePart

COMMAND = "beam-line check"
WATCHED_S = 2.0
FAILED = 1
MAX_REPEATS = 1_000
Rows = list[tuple[str, Sequence[float]]]

beam_line = command_group("beam-line", "Check the beam line that TIDEGATE_BEAM_LINE configures.")


@beam_line.callback()
def _beam_line() -> None:
    """Keep ``check`` a subcommand: typer turns a group of one command into that command."""


@beam_line.command()
def check(
    *,
    pulse: Annotated[
        float | None,
        typer.Option(help="Also permit the beam with leases of this length, 20 to 200 [ms].", show_default=False),
    ] = None,
    repeats: Annotated[int, typer.Option(help="Number of pulses.", min=1, max=MAX_REPEATS)] = 20,
    is_safe: Annotated[
        bool,
        typer.Option(
            "--yes-the-beam-is-safe", help="Confirm that the room is empty and the accelerator is in a safe state."
        ),
    ] = False,
    data: Annotated[Path | None, typer.Option(help="Data folder of the service; it must not be running.")] = None,
) -> None:
    """Open the beam line, read it back and measure its response times; with --pulse, also its switching times.

    Refused while a service uses the data folder: two programs must not control one beam line. The check switches the
    line off; with --pulse it PERMITS THE BEAM without any gating, and lets the heartbeat stand still: the receiver must
    drop the permit by itself.
    """
    if pulse is not None and not is_safe:
        raise refused(COMMAND, "--pulse permits the beam: it needs --yes-the-beam-is-safe")
    from engine.beam import PULSE_BOUNDS_MS
    from engine.core.errors import TidegateError
    from service.cli.data_folder import settings_of_folder
    from service.core.settings.settings import SettingsError, load_settings
    from service.engine_host.beam_lines import alone_at_targets
    from service.storage.files.folder_lock import alone_in

    low, high = PULSE_BOUNDS_MS
    if pulse is not None and not low <= pulse <= high:
        raise refused(COMMAND, f"--pulse is {pulse:g}: must be a number from {low:g} to {high:g} ms")
    try:
        settings = load_settings() if data is None else settings_of_folder(data)
        # No service can use a folder that does not exist; the check does not create it.
        alone = alone_in(settings.data_dir) if settings.data_dir.exists() else nullcontext()
        with alone, alone_at_targets(settings):
            _check(settings, pulse, repeats)
    except (SettingsError, TidegateError) as error:
        raise refused(COMMAND, error) from error


def _check(settings: "Settings", pulse_ms: float | None, repeats: int) -> None:
    from engine.beam import Pulser
    from engine.core.clock import MonotonicClock
    from service.engine_host.beam_lines import beam_line_parts, drilled_receivers, joined

    clock = MonotonicClock()
    parts = beam_line_parts(settings, clock)
    line = joined(parts)
    rows: Rows = []
    failure: TidegateError | None = None
    try:
        line.open()
        say(f"{' and '.join(settings.beam_lines)}: open, reads {'on' if line.is_on() else 'off'}")
        threading.Event().wait(WATCHED_S)
        line.is_on()  # raises if the line has reported a fault since
        if pulse_ms is not None:
            pulser = Pulser(line, clock, pulse_ms=pulse_ms, wait_ns=_wait_ns)
            rows += _pulsed(pulser, repeats)
            still, failure = _stood_still(pulser, drilled_receivers(settings, clock, parts), clock, repeats)
            rows += still
    finally:
        line.close()
    _print([*_answers(settings, parts), *rows])
    if failure is not None:
        say(f"tidegate {COMMAND}: failed: drill of the heartbeat: {failure}", "red")
        raise typer.Exit(FAILED)


def _answers(settings: "Settings", parts: "Sequence[LinePart]") -> Rows:
    from engine.beam import WiredBeamLine

    return [
        (f"{kind}: request -> answer", part.answers_ms if isinstance(part, WiredBeamLine) else ())
        for kind, part in zip(settings.beam_lines, parts, strict=True)
    ]


def _wait_ns(span_ns: int) -> None:
    from engine.core.clock import NS_PER_S

    threading.Event().wait(span_ns / NS_PER_S)


def _pulsed(pulser: "Pulser", repeats: int) -> Rows:
    pulser.arm()
    taken = []
    with frame_bar() as bar:
        task = bar.add_task("pulses", total=repeats)
        for done in range(repeats):
            taken.append(pulser.pulse())
            bar.update(task, completed=done + 1)
    return [
        ("permit -> read back on", [ms for times in taken for ms in times.on_ms]),
        ("hold -> read back off", [times.held_ms for times in taken]),
        ("end of lease -> read back off", [times.lapsed_ms for times in taken]),
    ]


def _stood_still(
    pulser: "Pulser", receivers: "Sequence[DrilledReceiver]", clock: "Clock", repeats: int
) -> "tuple[Rows, TidegateError | None]":
    """Let the heartbeat of every receiver stand still; return the times, and what failed."""
    from engine.beam import HeartbeatDrill, check_verifiable
    from engine.core.errors import BeamLineError

    drill = HeartbeatDrill(pulser, clock, _wait_ns)
    rows: Rows = []
    try:
        check_verifiable(receivers)
        for receiver in receivers:
            rows.append((f"{receiver.name}: last heartbeat -> contact open", drill.repeated_ms(receiver, repeats)))
    except BeamLineError as error:
        return rows, error
    return rows, None


def _print(rows: Rows) -> None:
    import numpy as np
    from rich.console import Console
    from rich.table import Table

    table = Table(show_edge=False)
    table.add_column("")
    for name in ("n", "median, ms", "p99, ms", "max, ms"):
        table.add_column(name, justify="right")
    for name, taken_ms in rows:
        figures = [*np.percentile(taken_ms, (50, 99)), max(taken_ms)] if taken_ms else []
        table.add_row(name, str(len(taken_ms)), *(f"{figure:.1f}" for figure in figures))
    Console(highlight=False).print(table)
