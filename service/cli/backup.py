"""``tidegate backup`` and ``tidegate restore``: all of a data folder and its database in one file, and back."""

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

from engine.errors import TidegateError
from service import audit
from service.audit import Event
from service.backup.layout import BackupError, BrokenLogError
from service.backup.making import Made, Source, make_backup, needed_bytes, refuse_full_disk
from service.backup.reading import opened
from service.backup.restoring import Target, check
from service.backup.restoring import restore as restore_backup
from service.cli.terminal import frame_bar, refused, say
from service.db.engine import Database
from service.db.models import ApiKeyRow, UserRow
from service.db.place import shown_place
from service.folder_lock import alone_in
from service.settings import Settings, SettingsError, load_settings

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from service.cli.terminal import NoBar

KINDNESS = 10
"""Behind a running service: the gate's frames come first."""

Data = Annotated[Path | None, typer.Option(help="Data folder; TIDEGATE_DATA_DIR where left out.")]


def backup(
    out: Annotated[Path, typer.Argument(help="File to write; must not exist.")],
    data: Data = None,
    has_raw: Annotated[bool, typer.Option("--raw", help="With the raw recordings of live cameras.")] = False,
    is_verified: Annotated[
        bool, typer.Option("--verify/--no-verify", help="Read it back and restore it into a scratch database.")
    ] = True,
) -> None:
    """Back up database, models, samples and tapes into one file, beside a running service or without one."""
    os.nice(KINDNESS)
    with _speaking("backup", data) as settings, closing(_database(settings)) as database:
        place = settings.database_place
        if isinstance(place, Path) and not place.is_file():
            msg = f"there is no database in {settings.data_dir}"
            raise BackupError(msg)
        source = Source(
            database=database, data_dir=settings.data_dir, anchor_file=settings.anchor_file, has_raw=has_raw
        )
        out = out.absolute()
        refuse_full_disk(out, needed_bytes(source) * (2 if is_verified else 1), settings.min_free_disk_mb)
        with _Bar.drawn() as bar:
            made = make_backup(source, out, bar)
            if is_verified:
                _check(made, out, bar)
        with database.write() as db:
            audit.append(db, _made_event(made, is_verified=is_verified))
        _tell(made, is_verified=is_verified)


def restore(
    file: Annotated[Path, typer.Argument(help="A file that `tidegate backup` wrote.")],
    data: Data = None,
    is_check: Annotated[bool, typer.Option("--check", help="Prove the file in a scratch database, and stop.")] = False,
    takes_broken_log: Annotated[
        bool, typer.Option("--accept-broken-log", help="Restore although the audit log in it is broken.")
    ] = False,
) -> None:
    """Restore a backup into an empty database and data folder; moves from SQLite to PostgreSQL and back, too."""
    with _speaking("restore", data) as settings, opened(file) as found:
        if is_check:
            with _Bar.drawn() as bar:
                check(found, file.absolute().parent, bar)
            say(f"{file} is whole: {found.manifest.rows} rows, {len(found.manifest.files)} files", "green")
            return
        with alone_in(settings.data_dir), closing(_database(settings)) as database, _Bar.drawn() as bar:
            target = Target(database=database, data_dir=settings.data_dir, anchor_file=settings.anchor_file)
            restore_backup(found, target, actor=_who(), name=file.name, progress=bar, takes_broken_log=takes_broken_log)
            people, keys = _let_in(database)
        manifest = found.manifest
        where = shown_place(settings.database_place)
        say(
            f"Restored into {where}: {manifest.rows} rows, {len(manifest.files)} files, as of {manifest.made_at}",
            "green",
        )
        say(
            f"{people} people and {keys} API keys are let in again as they were then: "
            "disable and revoke what was disabled and revoked since; changed passwords are the old ones",
            "yellow",
        )


class _Bar:
    """Shows one bar for the piece of work at hand."""

    def __init__(self, bar: "Progress | NoBar") -> None:
        self._bar = bar
        self._task: TaskID | None = None
        self._done = 0

    @classmethod
    @contextmanager
    def drawn(cls) -> Iterator["_Bar"]:
        """Draw it, where there is a terminal."""
        with frame_bar() as bar:
            yield cls(bar)

    def begin(self, what: str, total: int) -> None:
        """Begin a piece of work."""
        if self._task is None:
            self._task = self._bar.add_task(what, total=total)
        self._done = 0
        self._bar.update(self._task, description=what, total=total, completed=0)

    def advance(self, done: int) -> None:
        """Show that so much more is done."""
        self._done += done
        if self._task is not None:
            self._bar.update(self._task, completed=self._done)


def _let_in(database: Database) -> tuple[int, int]:
    """Count who may come in: a backup knows nothing of what was taken away after it was made."""
    now = datetime.now(UTC)
    is_valid = ApiKeyRow.revoked_at.is_(None) & (ApiKeyRow.expires_at > now)
    with database.read() as db:
        people = db.scalar(select(func.count()).select_from(UserRow).where(UserRow.is_disabled.is_(False)))
        return people or 0, db.scalar(select(func.count()).select_from(ApiKeyRow).where(is_valid)) or 0


def _check(made: Made, out: Path, bar: _Bar) -> None:
    try:
        with opened(out) as found:
            check(found, out.parent, bar)
    except BrokenLogError as error:
        msg = f"{out} was made, and restores with --accept-broken-log alone: {error}"
        raise BackupError(msg) from error
    except BackupError as error:
        out.rename(out.with_name(out.name + ".damaged"))
        msg = f"the backup of {made.manifest.rows} rows cannot be restored and was set aside: {error}"
        raise BackupError(msg) from error


def _made_event(made: Made, *, is_verified: bool) -> Event:
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
    }
    return Event(actor=_who(), action="backup.made", detail=detail)


def _tell(made: Made, *, is_verified: bool) -> None:
    manifest = made.manifest
    proof = "restored and found equal" if is_verified else "not verified"
    say(f"Backed up {manifest.rows} rows and {len(manifest.files)} files: {made.size_bytes} bytes ({proof})", "green")
    if manifest.without_samples:
        say(f"{len(manifest.without_samples)} sessions are in it without their samples: see its manifest", "yellow")
    typer.echo(f"{made.sha256}  {made.path.name}")


def _who() -> str:
    """Name whoever is at the shell, as the operating system does."""
    try:
        return f"{getpass.getuser()} (shell)"[:80]
    except (OSError, KeyError):
        return f"uid {os.getuid()} (shell)"


def _database(settings: Settings) -> Database:
    return Database(settings.database_place, answer_timeout_s=None)


@contextmanager
def _speaking(command: str, data: Path | None) -> Iterator[Settings]:
    try:
        yield load_settings(data_dir=data)
    except (SettingsError, TidegateError) as error:
        raise refused(command, error) from error
    except SQLAlchemyError as error:
        raise refused(command, f"the database does not answer ({type(error).__name__})") from error
    except OSError as error:
        raise refused(command, error.strerror or error) from error
