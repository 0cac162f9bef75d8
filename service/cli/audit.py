"""``tidegate audit``: prove that nobody changed the audit log, and take it along; both beside a running service."""

import getpass
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, TextIO

import typer
from sqlalchemy.exc import SQLAlchemyError

from engine.errors import TidegateError
from service.audit import SYSTEM, Event, Verification
from service.audit.anchors import AnchorFile
from service.audit.check import check_whole
from service.audit.export import MAX_LINE_CHARACTERS, ExportFormat, ExportRequest, verify_export, write_export
from service.audit.walk import head_sequence
from service.audit_log import AuditLog
from service.cli.terminal import advance, frame_bar, refused, say
from service.db.engine import Database
from service.errors import BoundError, NotFoundError
from service.settings import Settings, SettingsError, load_settings

BROKEN = 1
STANDARD_OUTPUT = Path("-")
DataOption = Annotated[Path | None, typer.Option(help="Folder of the database; TIDEGATE_DATA_DIR when left out.")]

audit = typer.Typer(no_args_is_help=True, help="Prove that nobody changed the audit log, and take it along.")


@audit.command()
def verify(
    data: DataOption = None,
    export: Annotated[
        Path | None, typer.Option(help="Check this export by itself, instead of a database; - reads standard input.")
    ] = None,
) -> None:
    """Walk the whole chain and hold it against the heads kept outside; exit code 1 names the first broken row."""
    if export is not None:
        found = _verified_file(export)
    else:
        with _database("audit verify", data) as (settings, database):
            found = _verified(settings, database)
    for note in found.notes:
        say(f"Note: {note}", "yellow")
    if found.is_intact:
        typer.echo(f"intact: {found.rows} rows, head {found.head_hash or '(none)'}")
        return
    where = "" if found.first_broken_sequence is None else f" at row {found.first_broken_sequence}"
    typer.echo(f"BROKEN{where} ({found.breakage}): {found.detail}; {found.rows} rows before it hold")
    raise typer.Exit(BROKEN)


@audit.command(name="export")
def export_rows(
    out: Annotated[Path, typer.Option(help="File to write, which must not be there yet; - is standard output.")],
    form: Annotated[ExportFormat, typer.Option("--format", help="JSON lines, or FHIR R4 AuditEvents.")] = (
        ExportFormat.JSONL
    ),
    since: Annotated[str | None, typer.Option("--from", help="From this time on, such as 2026-11-21T00:00Z.")] = None,
    until: Annotated[str | None, typer.Option("--to", help="Before this time.")] = None,
    session: Annotated[str | None, typer.Option(help="Only what belongs to this session.")] = None,
    with_patients: Annotated[bool, typer.Option(help="FHIR resources name the patient's reference.")] = False,
    data: DataOption = None,
) -> None:
    """Export the audit; that it was exported is written into it first."""
    with _database("audit export", data) as (settings, database):
        request = ExportRequest(
            format=form,
            since=_time("from", since),
            until=_time("to", until),
            session_id=session,
            with_patients=with_patients,
        )
        detail = {**request.told(), "via": "the command line", "account": _account()}
        AuditLog(database).write(Event(actor=SYSTEM, action="audit.export", session_id=session, detail=detail))
        lines = _write(write_export(database, request, site=settings.site_name), out)
    say(f"{lines} lines written{'' if out == STANDARD_OUTPUT else f' to {out}'}")


def _verified(settings: Settings, database: Database) -> Verification:
    with database.read() as db:
        total = head_sequence(db)
    with frame_bar() as bar:
        task = bar.add_task("rows", total=total)
        return check_whole(database, AnchorFile(settings.anchor_file), on_piece=lambda rows: advance(bar, task, rows))


def _verified_file(path: Path) -> Verification:
    try:
        if path == STANDARD_OUTPUT:
            return verify_export(_bounded_lines(sys.stdin))
        with path.open(encoding="utf-8") as file:
            return verify_export(_bounded_lines(file))
    except (OSError, UnicodeDecodeError) as error:
        raise refused("audit verify", f"{path} cannot be read ({error})") from error


def _bounded_lines(file: TextIO) -> Iterator[str]:
    while line := file.readline(MAX_LINE_CHARACTERS):
        yield line


def _write(pieces: Iterator[str], out: Path) -> int:
    if out == STANDARD_OUTPUT:
        return _write_lines(pieces, sys.stdout)
    try:
        with out.open("x", encoding="utf-8") as file:
            out.chmod(0o600)
            return _write_lines(pieces, file)
    except OSError as error:
        raise refused("audit export", f"{out} cannot be written ({error.strerror or error})") from error


def _write_lines(pieces: Iterator[str], file: TextIO) -> int:
    lines = 0
    for piece in pieces:
        file.write(piece)
        lines += piece.count("\n")
    return lines


@contextmanager
def _database(command: str, data: Path | None) -> Iterator[tuple[Settings, Database]]:
    """Open a data folder's database; nothing is made where there is none."""
    try:
        settings = load_settings(data_dir=data)
        place = settings.database_place
        if isinstance(place, Path) and not place.is_file():
            raise NotFoundError(f"there is no audit log in {settings.data_dir}: no database", field="data")
        with closing(Database(place)) as database:
            yield settings, database
    except (SettingsError, TidegateError) as error:
        raise refused(command, error) from error
    except SQLAlchemyError as error:
        raise refused(command, f"the database does not answer ({type(error).__name__})") from error


def _time(name: str, text: str | None) -> datetime | None:
    if text is None:
        return None
    try:
        found = datetime.fromisoformat(text)
    except ValueError as error:
        bound = "a time as in 2026-11-21T08:00Z"
        raise BoundError(f"--{name} must be {bound}", field=name, value=text, bound=bound) from error
    return found if found.tzinfo is not None else found.replace(tzinfo=UTC)


def _account() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "unknown"
