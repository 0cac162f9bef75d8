"""What `tidegate users` and `tidegate keys` share: a data folder that nobody else uses, opened and closed."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

import typer
from rich.console import Console
from sqlalchemy.exc import SQLAlchemyError

from engine.errors import TidegateError
from service.access.keys import KeyDesk
from service.access.passwords import Argon2Hashing
from service.access.people import PeopleDesk
from service.access.store import AccessStore
from service.folder_lock import alone_in
from service.settings import SettingsError, load_settings

BY = "command line"
"""The audit's actor: whoever may write in the data folder may do all of this, and nothing tells who it was."""
DataOption = typer.Option(help="Folder of the database.", show_default=False)
console = Console(highlight=False)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Desks:
    """People and keys of a data folder."""

    people: PeopleDesk
    keys: KeyDesk
    store: AccessStore


@contextmanager
def desks_of(data: Path | None, command: str) -> Iterator[Desks]:
    """Open a data folder for oneself; says in one line what stands against that, or against what is asked."""
    from service.db.engine import Database
    from service.db.preparing import prepare

    try:
        settings = load_settings(data_dir=data)
        with alone_in(settings.data_dir):
            database = Database(settings.database_place)
            try:
                prepare(database, data_dir=settings.data_dir, min_free_disk_mb=settings.min_free_disk_mb)
                store = AccessStore(database)
                store.load()
                yield Desks(
                    store=store,
                    people=PeopleDesk(store, Argon2Hashing().hash),
                    keys=KeyDesk(store, longest=timedelta(days=settings.key_max_days)),
                )
            finally:
                database.close()
    except (SettingsError, TidegateError, SQLAlchemyError) as error:
        said = "the database does not answer" if isinstance(error, SQLAlchemyError) else str(error)
        Console(stderr=True, highlight=False).print(
            f"tidegate {command}: {said}", style="red", soft_wrap=True, markup=False
        )
        raise typer.Exit(2) from error


def say(text: str) -> None:
    """Print a line as it is."""
    console.print(text, soft_wrap=True, markup=False)


def table_of(headings: list[str], rows: list[list[str]], print_line: Callable[[str], None] = say) -> None:
    """Print rows under headings, in columns wide enough for both."""
    widths = [max(len(row[place]) for row in [headings, *rows]) for place in range(len(headings))]
    for row in [headings, *rows]:
        print_line("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip())
