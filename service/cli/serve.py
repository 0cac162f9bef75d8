"""``tidegate serve``: the service on this machine."""

import gc
import os
import resource
import socket
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from service.access.addresses import LOOPBACK
from service.folder_lock import FolderInUseError, alone_in
from service.private_log import install_private_log
from service.settings import Settings, SettingsError, load_settings
from service.stopping import leave_at_once
from service.unhurried_log import UnhurriedHandler

SWITCH_INTERVAL_S = 0.001
MOST_FILES = 65_536
OTHERS_MAY_NOTHING = 0o077
"""Of every file that the service makes: models, samples, tapes, heads."""


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
        os.umask(OTHERS_MAY_NOTHING)
        with alone_in(settings.data_dir):
            _run(settings, console)
    except FolderInUseError as error:
        console.print(f"tidegate serve: {error}", style="red", soft_wrap=True, markup=False)
        raise typer.Exit(2) from error
    leave_at_once()


def _run(settings: Settings, console: Console) -> None:
    from service.app import create_app
    from service.engine_process.port import ProcessEngine
    from service.server import CertificateError, make_server

    install_private_log(settings.log_level, settings.log_format, handler=UnhurriedHandler())
    # The engine thread gets the interpreter back from an API thread within this time, not within the default 5 ms.
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    _warn(settings, console)
    _take_all_connections()
    app = create_app(settings, ProcessEngine, tell_first=lambda name, password: _tell_first(console, name, password))
    try:
        server = make_server(
            app,
            host=settings.host,
            port=settings.port,
            tls_cert=settings.tls_cert,
            tls_key=settings.tls_key,
            doors=settings.doors,
            max_body_bytes=max(settings.max_body_bytes, settings.max_plan_bytes),
            leave=os._exit,
            trusted_proxies=(settings.trusted_proxies or LOOPBACK) if settings.behind_proxy else (),
        )
    except CertificateError as error:
        console.print(f"tidegate serve: {error}", style="red", soft_wrap=True, markup=False)
        raise typer.Exit(2) from error
    _set_memory_aside()
    line = "SIMULATED beam line" if settings.is_simulated_beam else f"beam line {' and '.join(settings.beam_lines)}"
    scheme = "https" if settings.has_tls else "http"
    console.print(
        f"Tidegate on {scheme}://{settings.host}:{settings.port}/ ({line}; {settings.mode} mode, not cleared)"
    )
    server.run()


def _warn(settings: Settings, console: Console) -> None:
    """Say aloud what a site has set that somebody has to answer for."""
    if settings.behind_proxy and not settings.trusted_proxies:
        console.print(
            "TIDEGATE_BEHIND_PROXY: nobody on the way to this port may read it but the proxy; name its address in "
            "TIDEGATE_TRUSTED_PROXIES, or all log-ins count as coming from one place.",
            style="yellow",
            soft_wrap=True,
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


def _tell_first(console: Console, name: str, password: str) -> None:
    """Tell the person at this terminal, once; it stands in no log and in no file."""
    console.print(
        f"Nobody can log in yet. The first person is {name!r}, with this password, told once and to be changed at the "
        f"first log-in:\n\n    {password}\n",
        style="bold",
        soft_wrap=True,
        markup=False,
    )


def _take_all_connections() -> None:
    """Open as many connections as the system lets: strangers who only keep some open must not keep a hold out."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    enough = MOST_FILES if most == resource.RLIM_INFINITY else min(most, MOST_FILES)
    resource.setrlimit(resource.RLIMIT_NOFILE, (enough, most))


def _set_memory_aside() -> None:
    """Keep the collector away from what lives as long as the process: walking it stops every thread for a frame."""
    gc.collect()
    gc.freeze()


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
