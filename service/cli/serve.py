"""``tidegate serve``: the service on this machine."""

import gc
import logging
import signal
import socket
import sys
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer
from rich.console import Console

from service.folder_lock import FolderInUseError, alone_in
from service.settings import Settings, SettingsError, load_settings

SWITCH_INTERVAL_S = 0.001


def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on.")] = None,
    data: Annotated[Path | None, typer.Option(help="Folder of the database and the models.")] = None,
    recordings: Annotated[
        list[Path] | None, typer.Option(help="Folder that recordings may be opened from; repeatable.")
    ] = None,
) -> None:
    """Run the service: sessions, gate, live page and audit log. Everything else is set with TIDEGATE_* variables."""
    console = Console(stderr=True, highlight=False)
    try:
        settings = load_settings(
            host=host, port=port, data_dir=data, recordings_dirs=tuple(recordings) if recordings else None
        )
    except SettingsError as error:
        console.print(f"tidegate serve: {error}", style="red", soft_wrap=True, markup=False)
        raise typer.Exit(2) from error
    _refuse_taken_port(settings, console)
    try:
        with alone_in(settings.data_dir):
            _run(settings, console)
    except FolderInUseError as error:
        console.print(f"tidegate serve: {error}", style="red", soft_wrap=True, markup=False)
        raise typer.Exit(2) from error


def _run(settings: Settings, console: Console) -> None:
    from service.app import create_app
    from service.server import make_server

    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(levelname)s %(name)s %(message)s")
    # The engine thread gets the interpreter back from an API thread within this time, not within the default 5 ms.
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    if settings.allow_remote:
        console.print(
            f"TIDEGATE_ALLOW_REMOTE: listening on {settings.host} WITHOUT users or passwords. Anyone who can reach "
            "this port can arm the gate.",
            style="bold red",
            markup=False,
        )
    if settings.recordings_may_gate and settings.has_real_beam:
        console.print(
            f"TIDEGATE_RECORDINGS_MAY_GATE: a played recording may turn on a REAL beam line "
            f"({' and '.join(settings.beam_lines)}). Nobody may be in that beam.",
            style="bold red",
            soft_wrap=True,
            markup=False,
        )
    app = create_app(settings)
    _set_memory_aside()
    line = "SIMULATED beam line" if settings.is_simulated_beam else f"beam line {' and '.join(settings.beam_lines)}"
    console.print(f"Tidegate on http://{settings.host}:{settings.port}/ ({line}; {settings.mode} mode, not cleared)")
    # Uvicorn raises the signal again once it has shut down; asked to stop and stopped is success.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _already_obeyed)
    make_server(app, host=settings.host, port=settings.port).run()


def _set_memory_aside() -> None:
    """Keep the collector away from what lives as long as the process: walking it stops every thread for a frame."""
    gc.collect()
    gc.freeze()


def _already_obeyed(_number: int, _frame: FrameType | None) -> None:
    """Take the signal that uvicorn passes on after its shutdown."""


def _refuse_taken_port(settings: Settings, console: Console) -> None:
    """Say in one line that the port is taken, before anything is opened."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((settings.host, settings.port))
        except OSError as error:
            console.print(
                f"tidegate serve: cannot listen on {settings.host}:{settings.port}: {error.strerror}", style="red"
            )
            raise typer.Exit(2) from error
