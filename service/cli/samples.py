"""``tidegate samples``: sizes of the stored samples, and their check against the audit log."""

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from service.cli.command_group import command_group
from service.cli.data_folder import settings_of_database, settings_of_folder
from service.cli.terminal import refused
from service.core.errors import NotFoundError
from service.core.settings.settings import SettingsError
from service.storage.database.engine import Database
from service.storage.database.queries import OPEN_STATUSES
from service.storage.database.startup import SAMPLES_FOLDER
from service.storage.database.tables import SessionRow
from service.storage.files.cleanup import MIB, folder_bytes
from service.storage.samples.check import Finding, check, registered
from service.storage.samples.store import SampleStore

samples = command_group("samples", "List the stored samples of every session with their sizes, or verify them.")
Data = Annotated[Path | None, typer.Option(help="Data folder; TIDEGATE_DATA_DIR by default.")]
QUOTA_OFF = "none"


@samples.callback(invoke_without_command=True, no_args_is_help=False)
def list_samples(context: typer.Context, data: Data = None) -> None:
    """List the sample files of every session with their sizes."""
    if context.invoked_subcommand is not None:
        return
    try:
        settings = settings_of_folder(data)
    except (SettingsError, NotFoundError) as error:
        raise refused("samples", error) from error
    store = SampleStore(settings.data_dir / SAMPLES_FOLDER)
    table = Table("session", "file", "MiB", box=None)
    paths = sorted(store.folder.glob("*")) if store.folder.is_dir() else []
    for path in paths:
        table.add_row(path.name.partition(".")[0], path.name.partition(".")[2], f"{path.stat().st_size / MIB:.2f}")
    console = Console(highlight=False)
    console.print(table)
    quota = f"{settings.data_quota_gb:g} GiB" if settings.data_quota_gb else QUOTA_OFF
    console.print(
        f"{len(paths)} files; the data folder holds {folder_bytes(settings.data_dir) / MIB:.1f} MiB; quota {quota}"
    )


@samples.command()
def verify(
    session: Annotated[str | None, typer.Argument(help="Id of the session.")] = None,
    is_all: Annotated[bool, typer.Option("--all", help="Verify all sessions.")] = False,
    data: Data = None,
) -> None:
    """Read samples and compare them with the digests in the audit log.

    Exit code 0 when all are intact, 1 when not, 2 when the check could not run.
    """
    if (session is None) is not is_all:
        raise refused("samples verify", "give one SESSION, or --all")
    try:
        settings = settings_of_database(data)
        with closing(Database(settings.database_place)) as database:
            findings = _findings(database, SampleStore(settings.data_dir / SAMPLES_FOLDER), session)
    except (SettingsError, NotFoundError) as error:
        raise refused("samples verify", error) from error
    except SQLAlchemyError as error:
        raise refused("samples verify", f"the database cannot be read ({type(error).__name__})") from error
    _print_findings(findings)
    raise typer.Exit(0 if all(finding.is_good for finding in findings) else 1)


def _findings(database: Database, store: SampleStore, session: str | None) -> list[Finding]:
    """Check one session, or all of them and the files that belong to no session."""
    with database.read() as db:
        rows = db.execute(select(SessionRow.id, SessionRow.status).order_by(SessionRow.created_at)).all()
    statuses = {session_id: status for session_id, status in rows if session in {None, session_id}}
    if session is not None and not statuses:
        raise refused("samples verify", f"there is no session {session}")
    found = []
    for session_id in track(list(statuses), "reading", console=Console(stderr=True), transient=True):
        with database.read() as db:
            known = registered(db, session_id)
        found.append(check(store, session_id, known, is_open=statuses[session_id] in OPEN_STATUSES))
    if session is None:
        orphans = {*store.stored(), *store.left_streams()} - statuses.keys()
        found += [_orphan(session_id) for session_id in sorted(orphans)]
    return found


def _orphan(session_id: str) -> Finding:
    detail = "there is no such session"
    return Finding(session_id=session_id, form="none", rows=0, size=0, is_good=False, detail=detail)


def _print_findings(findings: list[Finding]) -> None:
    table = Table("session", "form", "rows", "MiB", "", box=None)
    for finding in findings:
        style = None if finding.is_good else "bold red"
        size = f"{finding.size / MIB:.2f}"
        table.add_row(finding.session_id, finding.form, str(finding.rows), size, finding.detail, style=style)
    console = Console(highlight=False, soft_wrap=True)
    console.print(table)
    bad = sum(not finding.is_good for finding in findings)
    console.print(f"{len(findings)} sessions, {bad} not intact")
