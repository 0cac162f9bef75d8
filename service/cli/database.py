"""``tidegate database``: where the tables stand, their way up, and their way down, which may lose something."""

from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from typing import Annotated

import typer
from sqlalchemy.exc import SQLAlchemyError

from engine.errors import TidegateError
from service.cli.terminal import refused, say
from service.db.engine import Database
from service.db.migrating import BASE, losses, standing, titles
from service.db.place import shown_place
from service.db.preparing import SAMPLES_FOLDER, prepare
from service.folder_lock import alone_in
from service.settings import Settings, SettingsError, load_settings

database = typer.Typer(
    help="The tables: where they stand, up to this version's, down to an older one's.", no_args_is_help=True
)
Data = Annotated[Path | None, typer.Option(help="Folder of the database; TIDEGATE_DATA_DIR where left out.")]


@database.command()
def status(data: Data = None) -> None:
    """Print which revision the tables are at, and what is still to come."""
    with _opened("status", data, is_alone=False) as (_, there):
        with there.connect() as connection:
            found = standing(connection)
        words = titles()
        typer.echo(f"{shown_place(there.place)}: {_named(found.revision)}")
        for revision in found.ahead:
            typer.echo(f"  to come: {revision} {words[revision]}")


@database.command()
def upgrade(data: Data = None) -> None:
    """Bring the tables to this version's; a service does so by itself when it starts."""
    import logging

    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    with _opened("upgrade", data, is_alone=True) as (settings, there):
        prepare(there, data_dir=settings.data_dir, min_free_disk_mb=settings.min_free_disk_mb)
        with there.connect() as connection:
            say(f"The tables are at {_named(standing(connection).revision)}", "green")


@database.command()
def downgrade(
    revision: Annotated[str, typer.Argument(help="Revision to go down to; `tidegate database status` lists them.")],
    data: Data = None,
    is_forced: Annotated[bool, typer.Option("--force", help="Lose what has no place in the older tables.")] = False,
) -> None:
    """Bring the tables back to an older version's; refused where that would lose something."""
    with _opened("downgrade", data, is_alone=True) as (settings, there):
        known = [BASE, *titles()]
        with there.connect() as connection:
            now = standing(connection).revision or BASE
            if revision not in known or known.index(revision) >= known.index(now):
                older = ", ".join(known[: known.index(now)]) or "none"
                raise refused("database downgrade", f"{revision} is no revision older than {now}: {older}")
            lost = losses(connection, revision)
        if lost and not is_forced:
            text = "\n  ".join(lost)
            raise refused("database downgrade", f"this would be lost; --force does it all the same:\n  {text}")
        there.downgrade(revision, samples_dir=settings.data_dir / SAMPLES_FOLDER)
        say(f"The tables are at {_named(None if revision == BASE else revision)}", "yellow" if lost else "green")


@contextmanager
def _opened(command: str, data: Path | None, *, is_alone: bool) -> Iterator[tuple[Settings, Database]]:
    """Open the database; beside a running service only to look."""
    try:
        settings = load_settings(data_dir=data)
        with alone_in(settings.data_dir) if is_alone else nullcontext():
            place = settings.database_place
            if isinstance(place, Path) and not is_alone and not place.is_file():
                raise refused(f"database {command}", f"there is no database in {settings.data_dir}")
            with closing(Database(place)) as there:
                yield settings, there
    except (SettingsError, TidegateError) as error:
        raise refused(f"database {command}", error) from error
    except SQLAlchemyError as error:
        raise refused(f"database {command}", f"the database does not answer ({type(error).__name__})") from error


def _named(revision: str | None) -> str:
    return "no revision yet: no tables" if revision is None else f"revision {revision} ({titles()[revision]})"
