"""``tidegate serve``: run the service in this process."""

import gc
import logging
import os
import resource
import socket
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engine import __version__
from service.cli.terminal import refused, say

if TYPE_CHECKING:
    from service.core.settings.settings import Settings
    from service.engine_host.process.process_engine import ProcessEngine
    from service.qa.jobs import QaRig

SWITCH_INTERVAL_S = 0.001
"""The engine thread gets the interpreter back from an API thread within this time; Python's default is 5 ms."""
MOST_FILES = 65_536
LATE_LIBRARIES = ("pyarrow", "pyarrow.compute", "pyarrow.parquet", "cv2")
"""Sixty megabytes that a service needs for its first session."""
UMASK = 0o077
"""Models, samples, tapes and audit anchors are readable by the service's own account only."""

start_log = logging.getLogger("tidegate.start")
"""Steps of the start, in the log's format and at any log level."""


def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on.")] = None,
    data: Annotated[
        Path | None, typer.Option(help="Data folder: database, models, samples, tapes; created if it does not exist.")
    ] = None,
    recordings: Annotated[
        list[Path] | None, typer.Option(help="Folder with recordings that sessions may play; repeatable.")
    ] = None,
) -> None:
    """Run the service: sessions, gate, web page, HTTP API and audit log.

    The other settings stand in the file that TIDEGATE_CONFIG names; see tidegate config show.
    """
    if os.environ.get("TIDEGATE_LOG_FORMAT") != "json":  # the next line, after a second of imports, is in any format
        say(f"Tidegate {__version__} starting")
    from engine.core.errors import TidegateError
    from engine.core.native_process import share_one_heap
    from service.core.late_modules import load_when_used
    from service.core.logging.nonblocking import flush_log

    share_one_heap()
    load_when_used(*LATE_LIBRARIES)
    from service.core.settings.settings import SettingsError, load_settings
    from service.engine_host.beam_lines import alone_at_targets
    from service.engine_host.site_limits.recording_folders import refuse_same_names
    from service.storage.files.folder_lock import alone_in
    from service.web.shutdown import leave_at_once

    for folder in recordings or ():
        if not folder.is_dir():
            raise refused("serve", f"--recordings {folder}: there is no such folder")
    try:
        settings = load_settings(
            host=host, port=port, data_dir=data, recordings_dirs=tuple(recordings) if recordings else None
        )
        refuse_same_names(settings.recording_folders)
        _refuse_taken_port(settings)
        os.umask(UMASK)
        with alone_in(settings.data_dir), alone_at_targets(settings):
            _run(settings)
    except (SettingsError, TidegateError) as error:
        flush_log()
        raise refused("serve", error) from error
    leave_at_once()


def _run(settings: "Settings") -> None:
    from service.core.logging.nonblocking import NonblockingHandler
    from service.core.logging.redaction import install_private_log
    from service.core.settings.database_place import shown_place

    install_private_log(settings.log_level, settings.log_format, handler=NonblockingHandler(), room=settings.room)
    start_log.setLevel(logging.INFO)
    database = shown_place(settings.database_place)
    room = settings.room or "without a name"
    place = settings.data_dir.absolute()
    start_log.info("Tidegate %s: room %s, data folder %s, database %s", __version__, room, place, database)
    _warn(settings)
    from service.engine_host.plug_ins import use_plug_ins
    from service.engine_host.process.process_engine import ProcessEngine

    for plug_in in use_plug_ins(settings):
        start_log.info("plug-in %s of %s", plug_in.name, plug_in.label)
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    _raise_file_limit()
    gc.disable()  # until all is loaded: a seventh of the start went into looking through what stays
    # Before the web server's imports, which take as long as those of the engine's process: they run side by side.
    engine = ProcessEngine(settings)
    try:
        _serve(settings, engine)
    finally:
        gc.enable()
        engine.close()


def _rig(settings: "Settings") -> "QaRig":
    """Return what builds QA jobs; a clinical service has no virtual set-up."""
    from service.qa.late_rig import LateRig
    from service.qa.virtual_setups import SimulatingRig

    return LateRig(settings) if settings.mode == "clinical" else SimulatingRig(settings)


def _serve(settings: "Settings", engine: "ProcessEngine") -> None:
    from service.access.request.addresses import LOOPBACK
    from service.core.logging.nonblocking import flush_log
    from service.monitoring.certificate import CertificateError
    from service.web.app import create_app
    from service.web.server import make_server

    try:
        app = create_app(settings, lambda _settings: engine, _rig, tell_first=_print_first_password)
    except CertificateError as error:
        flush_log()
        raise refused("serve", error) from error
    server = make_server(
        app,
        host=settings.host,
        port=settings.port,
        certificate=app.state.certificate,
        leave=os._exit,
        trusted_proxies=(settings.trusted_proxies or LOOPBACK) if settings.behind_proxy else (),
        on_listening=lambda: start_log.info("%s", _listening(settings)),
    )
    _exclude_from_garbage_collection()
    start_log.info("opening the database and the audit log")
    server.run()


def _listening(settings: "Settings") -> str:
    line = "SIMULATED beam line" if settings.is_simulated_beam else f"beam line {' and '.join(settings.beam_lines)}"
    address = f"{'https' if settings.has_tls else 'http'}://{settings.host}:{settings.port}/"
    return f"listening on {address} ({line}; {settings.mode} mode; not cleared for clinical use)"


def _warn(settings: "Settings") -> None:
    """Log the settings that remove a protection."""
    if settings.behind_proxy and not settings.trusted_proxies:
        start_log.warning(
            "TIDEGATE_BEHIND_PROXY: only the proxy may be able to reach this port; set TIDEGATE_TRUSTED_PROXIES to its "
            "address, or all log-in attempts count as coming from one address"
        )
    if settings.recordings_may_gate and settings.has_real_beam:
        start_log.warning(
            "TIDEGATE_RECORDINGS_MAY_GATE: a played recording may turn on a REAL beam line (%s). Keep everybody out of "
            "that beam",
            " and ".join(settings.beam_lines),
        )


def _print_first_password(name: str, password: str) -> None:
    """Print the first account's password on standard output only: it is in none of our logs and files."""
    say(
        f"No account exists yet. The first account is {name!r} with this one-time password, shown only now, to be "
        f"changed at the first log-in:\n\n    {password}\n"
    )


def _raise_file_limit() -> None:
    """Raise the limit of open files, so that many idle connections do not keep a hold request out."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    enough = MOST_FILES if most == resource.RLIM_INFINITY else min(most, MOST_FILES)
    resource.setrlimit(resource.RLIMIT_NOFILE, (enough, most))


def _exclude_from_garbage_collection() -> None:
    """Exclude the objects that exist now: collecting among them stops every thread for the time of a frame."""
    gc.collect()
    gc.freeze()
    gc.enable()


def _refuse_taken_port(settings: "Settings") -> None:
    """Refuse a port that is in use, before anything is opened."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((settings.host, settings.port))
        except OSError as error:
            where = f"{settings.host}:{settings.port}"
            raise refused("serve", f"cannot listen on {where}: {error.strerror}") from error
