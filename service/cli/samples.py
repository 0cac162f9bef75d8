"""``tidegate samples``: how much every session's samples take, and whether they are what the audit says."""

from contextlib import closing
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.console import Console
from rich.progress import track
from rich.table import Table
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from service.db.engine import Database
from service.db.models import SessionRow
from service.db.preparing import SAMPLES_FOLDER
from service.db.repository import OPEN_STATUSES
from service.samples.check import Finding, check
from service.samples.register import registered
from service.samples.shelf import SampleShelf
from service.settings import Settings, SettingsError, load_settings
from service.storage_room import MIB, folder_bytes

samples = typer.Typer(invoke_without_command=True, add_completion=False, pretty_exceptions_show_locals=False)
Data = Annotated[Path | None, typer.Option(help="Data folder; TIDEGATE_DATA_DIR where left out.")]
QUOTA_OFF = "none"


@samples.callback()
def list_samples(context: typer.Context, data: Data = None) -> None:
    """List every session's sample files with their sizes; see `verify` for whether they are whole."""
    if context.invoked_subcommand is not None:
        return
    settings = _settings(data)
    shelf = SampleShelf(settings.data_dir / SAMPLES_FOLDER)
    table = Table("session", "file", "MiB", box=None)
    paths = sorted(shelf.folder.glob("*")) if shelf.folder.is_dir() else []
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
    session: Annotated[str | None, typer.Argument(help="The session's id.")] = None,
    is_all: Annotated[bool, typer.Option("--all", help="Every session there is.")] = False,
    data: Data = None,
) -> None:
    """Read samples through and hold them against the audit; 0 is good, 1 is not, 2 could not be done."""
    if (session is None) is not is_all:
        _refuse("name one SESSION, or --all")
    settings = _settings(data)
    place = settings.database_place
    if isinstance(place, Path) and not place.is_file():
        _refuse(f"there is no database in {settings.data_dir}")
    try:
        with closing(Database(place)) as database:
            findings = _findings(database, SampleShelf(settings.data_dir / SAMPLES_FOLDER), session)
    except SQLAlchemyError as error:
        _refuse(f"the database cannot be read ({type(error).__name__})")
    _tell(findings)
    raise typer.Exit(0 if all(finding.is_good for finding in findings) else 1)


def _findings(database: Database, shelf: SampleShelf, session: str | None) -> list[Finding]:
    """Check one session, or all, and files that no session is known of."""
    with database.read() as db:
        rows = db.execute(select(SessionRow.id, SessionRow.status).order_by(SessionRow.created_at)).all()
    statuses = {session_id: status for session_id, status in rows if session in {None, session_id}}
    if session is not None and not statuses:
        _refuse(f"there is no session {session}")
    found = []
    for session_id in track(list(statuses), "reading", console=Console(stderr=True), transient=True):
        with database.read() as db:
            known = registered(db, session_id)
        found.append(check(shelf, session_id, known, is_open=statuses[session_id] in OPEN_STATUSES))
    if session is None:
        strays = {*shelf.stored(), *shelf.left_streams()} - statuses.keys()
        found += [_stray(session_id) for session_id in sorted(strays)]
    return found


def _stray(session_id: str) -> Finding:
    detail = "there is no such session"
    return Finding(session_id=session_id, form="none", rows=0, size=0, is_good=False, detail=detail)


def _tell(findings: list[Finding]) -> None:
    table = Table("session", "form", "rows", "MiB", "", box=None)
    for finding in findings:
        style = None if finding.is_good else "bold red"
        size = f"{finding.size / MIB:.2f}"
        table.add_row(finding.session_id, finding.form, str(finding.rows), size, finding.detail, style=style)
    console = Console(highlight=False, soft_wrap=True)
    console.print(table)
    bad = sum(not finding.is_good for finding in findings)
    console.print(f"{len(findings)} sessions, {bad} not as they should be")


def _settings(data: Path | None) -> Settings:
    try:
        return load_settings(data_dir=data)
    except SettingsError as error:
        _refuse(str(error))


def _refuse(why: str) -> NoReturn:
    Console(stderr=True, highlight=False).print(f"tidegate samples: {why}", style="red", soft_wrap=True, markup=False)
    raise typer.Exit(2)
