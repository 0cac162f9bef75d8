"""``tidegate backup`` and ``tidegate restore``: a data folder and its database in one file."""

import getpass
import os
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError

from engine.core.errors import TidegateError
from service.cli.data_folder import settings_of_database
from service.cli.terminal import frame_bar, refused, say
from service.core.settings.database_place import shown_place
from service.core.settings.settings import Settings, SettingsError, load_settings
from service.storage import audit
from service.storage.audit import Event
from service.storage.backup.archive import opened
from service.storage.backup.backup import CreatedBackup, Source, make_backup, needed_bytes, refuse_full_disk
from service.storage.backup.layout import BackupError, BrokenLogError, OtherRoomError
from service.storage.backup.restore import Target, check, restore as restore_backup
from service.storage.database.engine import Database
from service.storage.database.tables import ApiKeyRow, UserRow
from service.storage.files.folder_lock import alone_in

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from service.cli.terminal import NoBar

NICENESS = 10
"""Process priority below that of a running service, whose frames are real-time work."""

Data = Annotated[Path | None, typer.Option(help="Data folder; TIDEGATE_DATA_DIR by default.")]


def backup(
    out: Annotated[Path, typer.Argument(help="File to write; must not exist.")],
    data: Data = None,
    has_raw: Annotated[bool, typer.Option("--raw", help="Include raw recordings of live cameras.")] = False,
    is_verified: Annotated[
        bool,
        typer.Option("--verify/--no-verify", help="Read the backup again and restore it into a temporary database."),
    ] = True,
) -> None:
    """Back up database, models, samples and tapes to one file; the service may be running."""
    os.nice(NICENESS)
    with _refusals("backup"):
        settings = settings_of_database(data)
        with closing(_database(settings)) as database:
            _back_up(settings, database, out.absolute(), has_raw=has_raw, is_verified=is_verified)


def _back_up(settings: Settings, database: Database, out: Path, *, has_raw: bool, is_verified: bool) -> None:
    source = Source(
        database=database,
        data_dir=settings.data_dir,
        anchor_file=settings.anchor_file,
        has_raw=has_raw,
        room=settings.room,
    )
    refuse_full_disk(out, needed_bytes(source) * (2 if is_verified else 1), settings.min_free_disk_mb)
    with _Bar.drawn() as bar:
        made = make_backup(source, out, bar)
        if is_verified:
            _check(made, out, bar)
    with database.write() as db:
        audit.append(db, _made_event(made, is_verified=is_verified))
    _print_made(made, is_verified=is_verified)


def restore(
    file: Annotated[Path, typer.Argument(help="A file that `tidegate backup` wrote.")],
    data: Data = None,
    is_check: Annotated[bool, typer.Option("--check", help="Only verify the file in a temporary database.")] = False,
    takes_broken_log: Annotated[
        bool, typer.Option("--accept-broken-log", help="Restore although the audit log in the backup is broken.")
    ] = False,
    takes_other_room: Annotated[
        bool,
        typer.Option("--accept-other-room", help="Restore although the backup is of another room (TIDEGATE_ROOM)."),
    ] = False,
) -> None:
    """Restore a backup into an empty database and data folder, SQLite or PostgreSQL.

    A backup of one kind of database can be restored into the other.
    """
    with _refusals("restore"), opened(file) as found:
        settings = load_settings(data_dir=data)
        if is_check:
            with _Bar.drawn() as bar:
                check(found, file.absolute().parent, bar)
            say(f"{file} is intact: {found.manifest.rows} rows, {len(found.manifest.files)} files", "green")
            return
        with alone_in(settings.data_dir), closing(_database(settings)) as database, _Bar.drawn() as bar:
            target = Target(
                database=database, data_dir=settings.data_dir, anchor_file=settings.anchor_file, room=settings.room
            )
            restore_backup(
                found,
                target,
                actor=_os_user(),
                name=file.name,
                progress=bar,
                takes_broken_log=takes_broken_log,
                takes_other_room=takes_other_room,
            )
            people, keys = _valid_accounts_and_keys(database)
        manifest = found.manifest
        where = shown_place(settings.database_place)
        say(
            f"Restored into {where}: {manifest.rows} rows, {len(manifest.files)} files, as of {manifest.made_at}",
            "green",
        )
        say(
            f"{people} accounts and {keys} API keys are valid again, with the passwords "
            "that they had at the time of the backup: disable and revoke again what was disabled or revoked later",
            "yellow",
        )


class _Bar:
    """A progress bar that is reused for every step."""

    def __init__(self, bar: "Progress | NoBar") -> None:
        self._bar = bar
        self._task: TaskID | None = None
        self._done = 0

    @classmethod
    @contextmanager
    def drawn(cls) -> Iterator["_Bar"]:
        """Draw the bar if standard error is a terminal."""
        with frame_bar() as bar:
            yield cls(bar)

    def begin(self, what: str, total: int) -> None:
        """Start a step of ``total`` units."""
        if self._task is None:
            self._task = self._bar.add_task(what, total=total)
        self._done = 0
        self._bar.update(self._task, description=what, total=total, completed=0)

    def advance(self, done: int) -> None:
        """Add ``done`` units to the current step."""
        self._done += done
        if self._task is not None:
            self._bar.update(self._task, completed=self._done)


def _valid_accounts_and_keys(database: Database) -> tuple[int, int]:
    """Count the valid accounts and keys; the backup does not contain what was revoked after it was made."""
    now = datetime.now(UTC)
    is_valid = ApiKeyRow.revoked_at.is_(None) & (ApiKeyRow.expires_at > now)
    with database.read() as db:
        people = db.scalar(select(func.count()).select_from(UserRow).where(UserRow.is_disabled.is_(False)))
        return people or 0, db.scalar(select(func.count()).select_from(ApiKeyRow).where(is_valid)) or 0


def _check(made: CreatedBackup, out: Path, bar: _Bar) -> None:
    try:
        with opened(out) as found:
            check(found, out.parent, bar)
    except BrokenLogError as error:
        msg = f"{out} was written, but it can only be restored with --accept-broken-log: {error}"
        raise BackupError(msg) from error
    except BackupError as error:
        out.rename(out.with_name(out.name + ".damaged"))
        msg = f"the backup of {made.manifest.rows} rows cannot be restored; the file was renamed to *.damaged: {error}"
        raise BackupError(msg) from error


def _made_event(made: CreatedBackup, *, is_verified: bool) -> Event:
    manifest = made.manifest
    detail = {
        "file": made.path.name,
        "sha256": made.sha256,
        "bytes": made.size_bytes,
        "rows": manifest.rows,
        "files": len(manifest.files),
        "revision": manifest.revision,
        "audit_rows": manifest.audit_rows,
        "audit_head": manifest.audit_head,
        "sessions_without_samples": len(manifest.without_samples),
        "is_verified": is_verified,
        "room": manifest.room,
    }
    return Event(actor=_os_user(), action="backup.made", detail=detail)


def _print_made(made: CreatedBackup, *, is_verified: bool) -> None:
    manifest = made.manifest
    proof = "restored and compared" if is_verified else "not verified"
    say(f"Backed up {manifest.rows} rows and {len(manifest.files)} files: {made.size_bytes} bytes ({proof})", "green")
    if manifest.without_samples:
        say(
            f"{len(manifest.without_samples)} sessions are in it without their samples; the manifest lists them",
            "yellow",
        )
    typer.echo(f"{made.sha256}  {made.path.name}")


def _os_user() -> str:
    """Return the operating system's user name."""
    try:
        return f"{getpass.getuser()} (shell)"[:80]
    except (OSError, KeyError):
        return f"uid {os.getuid()} (shell)"


def _database(settings: Settings) -> Database:
    return Database(settings.database_place, answer_timeout_s=None)


@contextmanager
def _refusals(command: str) -> Iterator[None]:
    """End the command with one line if the work inside is refused."""
    try:
        yield
    except OtherRoomError as error:
        raise refused(command, f"{error}; --accept-other-room takes it over") from error
    except (SettingsError, TidegateError) as error:
        raise refused(command, error) from error
    except SQLAlchemyError as error:
        raise refused(command, f"the database does not answer ({type(error).__name__})") from error
    except OSError as error:
        raise refused(command, error.strerror or error) from error
