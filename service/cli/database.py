"""``tidegate database``: the schema revision of the database, its upgrade and its downgrade, which may lose data."""

from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from typing import Annotated

import typer
from sqlalchemy.exc import SQLAlchemyError

from engine.core.errors import TidegateError
from service.cli.command_group import command_group
from service.cli.data_folder import settings_of_database
from service.cli.terminal import refused, say
from service.core.settings.database_place import shown_place
from service.core.settings.settings import Settings, SettingsError, load_settings
from service.storage.database.engine import Database
from service.storage.database.identities import collisions
from service.storage.database.migrations import BASE, losses, schema_status, titles
from service.storage.database.startup import prepare
from service.storage.files.folder_lock import alone_in

database = command_group("database", "Print, upgrade or downgrade the schema revision of the database.")
Data = Annotated[Path | None, typer.Option(help="Data folder; TIDEGATE_DATA_DIR by default.")]


@database.command()
def status(data: Data = None) -> None:
    """Print the current schema revision and the revisions that an upgrade would apply."""
    with _opened("status", data, is_alone=False) as (_, there):
        with there.connect() as connection:
            found = schema_status(connection)
        words = titles()
        typer.echo(f"{shown_place(there.place)}: {_named(found.revision)}")
        for revision in found.ahead:
            typer.echo(f"  pending: {revision} {words[revision]}")
        if not found.ahead:
            with there.connect() as connection:
                for one in collisions(connection):
                    typer.echo(f"  {one.kind} {one.text!r} is like {one.like!r}: not merged, see that they are two")


@database.command()
def upgrade(data: Data = None) -> None:
    """Upgrade the schema to this version; a service does this when it starts."""
    import logging

    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    with _opened("upgrade", data, is_alone=True) as (settings, there):
        prepare(there, data_dir=settings.data_dir, min_free_disk_mb=settings.min_free_disk_mb)
        with there.connect() as connection:
            say(f"The schema is at {_named(schema_status(connection).revision)}", "green")


@database.command()
def downgrade(
    revision: Annotated[
        str, typer.Argument(help="An older revision; an unknown one is refused with the list of revisions.")
    ],
    data: Data = None,
    is_forced: Annotated[bool, typer.Option("--force", help="Delete data that the older schema cannot store.")] = False,
) -> None:
    """Downgrade the schema to an older revision; refused if data would be lost."""
    with _opened("downgrade", data, is_alone=True) as (_settings, there):
        known = [BASE, *titles()]
        with there.connect() as connection:
            now = schema_status(connection).revision or BASE
            if revision not in known or known.index(revision) >= known.index(now):
                older = ", ".join(known[: known.index(now)]) or "none"
                raise refused(
                    "database downgrade", f"{revision} is not a revision older than {now}; those are: {older}"
                )
            lost = losses(connection, revision)
        if lost and not is_forced:
            text = "\n  ".join(lost)
            raise refused("database downgrade", f"the older schema cannot store this; --force deletes it:\n  {text}")
        there.downgrade(revision)
        say(f"The schema is at {_named(None if revision == BASE else revision)}", "yellow" if lost else "green")


@contextmanager
def _opened(command: str, data: Path | None, *, is_alone: bool) -> Iterator[tuple[Settings, Database]]:
    """Open the database, without a service (``is_alone``) or beside one; only `upgrade` creates it."""
    try:
        settings = load_settings(data_dir=data) if command == "upgrade" else settings_of_database(data)
        lock = alone_in(settings.data_dir) if is_alone else nullcontext()
        with lock, closing(Database(settings.database_place)) as there:
            yield settings, there
    except (SettingsError, TidegateError) as error:
        raise refused(f"database {command}", error) from error
    except SQLAlchemyError as error:
        raise refused(f"database {command}", f"the database does not answer ({type(error).__name__})") from error


def _named(revision: str | None) -> str:
    return "no tables yet" if revision is None else f"revision {revision} ({titles()[revision]})"
