"""``tidegate audit``: verify and export the audit log; the service may be running."""

import getpass
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, TextIO

import typer
from sqlalchemy.exc import SQLAlchemyError

from engine.core.errors import TidegateError
from service.cli.command_group import command_group
from service.cli.data_folder import settings_of_database
from service.cli.terminal import advance, frame_bar, refused, say
from service.core.errors import BoundError
from service.core.settings.settings import Settings, SettingsError
from service.storage.audit import SYSTEM, Event, Verification
from service.storage.audit.anchors import AnchorFile
from service.storage.audit.check import check_chain, check_whole
from service.storage.audit.export import MAX_LINE_CHARACTERS, ExportRequest, verify_export, write_export
from service.storage.audit.log import AuditLog
from service.storage.audit.verification import head_sequence
from service.storage.database.engine import Database

BROKEN = 1
STANDARD_OUTPUT = Path("-")
DataOption = Annotated[Path | None, typer.Option(help="Data folder; TIDEGATE_DATA_DIR by default.")]

audit = command_group("audit", "Verify or export the audit log; the service may be running.")


@audit.command()
def verify(
    data: DataOption = None,
    export: Annotated[
        Path | None, typer.Option(help="Verify this exported file instead of a database; - reads standard input.")
    ] = None,
    without_anchors: Annotated[
        bool, typer.Option("--without-anchors", help="Verify the chain alone: a department's copy has no anchor file.")
    ] = False,
) -> None:
    """Verify the hash chain of the audit log and compare it with the anchor file.

    Exit code 0 when it is intact; 1 when it is broken, with the first broken row.
    """
    if export is not None and without_anchors:
        raise refused("audit verify", "--without-anchors is for a database; an export is never compared with anchors")
    if export is not None:
        found = _verified_file(export)
    else:
        with _database("audit verify", data) as (settings, database):
            found = _verified(settings, database, without_anchors=without_anchors)
    for note in found.notes:
        say(f"Note: {note}", "yellow")
    if found.is_intact:
        typer.echo(f"intact: {found.rows} rows, head {found.head_hash or '(none)'}")
        return
    where = "" if found.first_broken_sequence is None else f" at row {found.first_broken_sequence}"
    typer.echo(f"BROKEN{where} ({found.breakage}): {found.detail}; {found.rows} rows before it are intact")
    raise typer.Exit(BROKEN)


@audit.command(name="export")
def export_rows(
    out: Annotated[Path, typer.Option(help="File to write, which must not exist; - is standard output.")],
    since: Annotated[str | None, typer.Option("--from", help="First time, e.g. 2026-11-21T00:00Z.")] = None,
    until: Annotated[
        str | None, typer.Option("--to", help="End of the period; rows at this time are left out.")
    ] = None,
    session: Annotated[str | None, typer.Option(help="Only rows of this session.")] = None,
    with_patients: Annotated[bool, typer.Option(help="Include details that name a patient.")] = True,
    data: DataOption = None,
) -> None:
    """Export the audit log as JSON lines; the export itself is recorded in it first."""
    with _database("audit export", data) as (_settings, database):
        request = ExportRequest(
            since=_time("from", since),
            until=_time("to", until),
            session_id=session,
            with_patients=with_patients,
        )
        detail = {**request.audit_detail(), "via": "the command line", "account": _account()}
        AuditLog(database).write(Event(actor=SYSTEM, action="audit.export", session_id=session, detail=detail))
        lines = _write(write_export(database, request), out)
    say(f"{lines} lines written{'' if out == STANDARD_OUTPUT else f' to {out}'}")


def _verified(settings: Settings, database: Database, *, without_anchors: bool) -> Verification:
    with database.read() as db:
        total = head_sequence(db)
    with frame_bar() as bar:
        task = bar.add_task("rows", total=total)
        if without_anchors:
            return check_chain(database, on_piece=lambda rows: advance(bar, task, rows))
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
    """Open the database of a data folder; a failure ends the command with one line."""
    try:
        settings = settings_of_database(data)
        with closing(Database(settings.database_place)) as database:
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
