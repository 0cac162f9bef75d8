"""Accounts and API keys of a data folder that no service uses, opened and closed for one command."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Annotated

import typer
from sqlalchemy.exc import SQLAlchemyError

from engine.core.errors import TidegateError
from service.access.accounts.passwords import Argon2Hashing
from service.access.accounts.people import AccountService
from service.access.accounts.store import AccessStore
from service.access.login.keys import KeyService
from service.cli.data_folder import settings_of_database
from service.cli.terminal import refused
from service.core.settings.settings import SettingsError, load_settings
from service.storage.database.engine import Database
from service.storage.database.startup import prepare
from service.storage.files.folder_lock import alone_in

BY = "command line"
"""The actor in the audit log: the operating system does not prove which person wrote into the folder."""
Data = Annotated[Path | None, typer.Option(help="Data folder; TIDEGATE_DATA_DIR by default.", show_default=False)]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AccountServices:
    """Accounts and API keys of a data folder."""

    people: AccountService
    keys: KeyService
    store: AccessStore


@contextmanager
def account_services(data: Path | None, command: str, *, may_create: bool = False) -> Iterator[AccountServices]:
    """Lock and open a data folder; every refusal, also of the work inside, ends the command with one line.

    Parameters
    ----------
    may_create
        Create the folder and its database if they do not exist.
    """
    try:
        settings = load_settings(data_dir=data) if may_create else settings_of_database(data)
        with alone_in(settings.data_dir), closing(Database(settings.database_place)) as database:
            prepare(database, data_dir=settings.data_dir, min_free_disk_mb=settings.min_free_disk_mb)
            store = AccessStore(database)
            store.load()
            yield AccountServices(
                store=store,
                people=AccountService(store, Argon2Hashing().hash),
                keys=KeyService(store, longest=timedelta(days=settings.key_max_days)),
            )
    except SQLAlchemyError as error:
        raise refused(command, f"the database does not answer ({type(error).__name__})") from error
    except (SettingsError, TidegateError) as error:
        raise refused(command, error) from error


def print_table(headings: list[str], rows: list[list[str]]) -> None:
    """Print rows under headings on standard output, each column as wide as its widest text."""
    widths = [max(len(row[column]) for row in [headings, *rows]) for column in range(len(headings))]
    for row in [headings, *rows]:
        typer.echo("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip())
