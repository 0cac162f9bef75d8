"""Revisions of the tables: up, down, where a database stands, and what a way down would lose.

Both databases undo DDL: a migration happens whole or not at all, however it ends.
"""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import ClassVar

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import Script, ScriptDirectory
from sqlalchemy import Column, Connection, MetaData, Table, and_, func, select, true

from engine.errors import TidegateError
from service.db.sqlite import make_sqlite_engine

VERSION_TABLE = "alembic_version"
BASE = "base"


class MigrationError(TidegateError):
    """The tables cannot be brought to that revision."""

    code: ClassVar[str] = "migration_refused"


@dataclass(frozen=True, slots=True, kw_only=True)
class Standing:
    """Where a database's tables stand; ``revision`` is None before the first one."""

    revision: str | None
    head: str
    ahead: tuple[str, ...]
    """Revisions still to come, oldest first."""


def standing(connection: Connection) -> Standing:
    """Look where the tables stand.

    Raises
    ------
    MigrationError
        The tables were made by a newer version.
    """
    is_own = not connection.in_transaction()
    revision = MigrationContext.configure(connection).get_current_revision()
    if is_own:
        connection.rollback()
    scripts = [script.revision for script in _scripts()]
    if revision is not None and revision not in scripts:
        msg = (
            f"the database is at revision {revision}, made by a newer version of Tidegate; "
            f"this one knows up to {scripts[-1]}"
        )
        raise MigrationError(msg)
    ahead = scripts if revision is None else scripts[scripts.index(revision) + 1 :]
    return Standing(revision=revision, head=scripts[-1], ahead=tuple(ahead))


def titles() -> dict[str, str]:
    """Return what each revision is about, oldest first."""
    return {script.revision: script.doc.splitlines()[0] for script in _scripts()}


def upgrade(connection: Connection, revision: str, attributes: Mapping[str, object]) -> None:
    """Go up; within the connection's transaction where one has begun."""
    if not connection.in_transaction():
        standing(connection)  # a newer version's tables are refused in plain words
    with _config(connection, attributes) as config:
        command.upgrade(config, revision)


def downgrade(connection: Connection, revision: str, attributes: Mapping[str, object]) -> None:
    """Go down, whatever that loses."""
    standing(connection)
    with _config(connection, attributes) as config:
        command.downgrade(config, revision)


def losses(connection: Connection, revision: str) -> list[str]:
    """Name what is in the tables and has no place at an older revision: rows of a table, values of a column."""
    there, then = MetaData(), _tables_at(revision)
    there.reflect(connection)
    found: list[str] = []
    for table in there.sorted_tables:
        if table.name == VERSION_TABLE:
            continue
        older = then.tables.get(table.name)
        if older is None:
            found += _lost_rows(connection, table)
        else:
            gone = [column for column in table.columns if column.name not in older.columns]
            found += [text for column in gone for text in _lost_values(connection, table, column)]
    return found


def _lost_rows(connection: Connection, table: Table) -> list[str]:
    count = connection.scalar(select(func.count()).select_from(table)) or 0
    return [f"{table.name}: {count} rows"] if count else []


def _lost_values(connection: Connection, table: Table, column: Column[object]) -> list[str]:
    default = _default_of(column)
    is_said = and_(column.is_not(None), true() if default is None else column != default)
    count = connection.scalar(select(func.count()).select_from(table).where(is_said)) or 0
    return [f"{table.name}.{column.name}: {count} values"] if count else []


def _default_of(column: Column[object]) -> str | None:
    """Read a text column's default; `'{}'::text` is how PostgreSQL shows it."""
    shown = getattr(column.server_default, "arg", None)
    text = "" if shown is None else str(shown)
    return text.split("'")[1] if text.count("'") >= 2 else None


def _tables_at(revision: str) -> MetaData:
    """Make an empty database of a revision, and read its tables."""
    tables = MetaData()
    with tempfile.TemporaryDirectory() as folder:
        engine = make_sqlite_engine(Path(folder) / "empty.db", busy_timeout_s=1.0)
        try:
            with engine.connect() as connection:
                if revision != BASE:
                    upgrade(connection, revision, {})
                tables.reflect(connection)
        finally:
            engine.dispose()
    return tables


def _scripts() -> Sequence[Script]:
    """Return all revisions, oldest first."""
    with as_file(files("migrations")) as folder:
        return tuple(reversed(list(ScriptDirectory.from_config(migration_config(folder)).walk_revisions())))


@contextmanager
def _config(connection: Connection, attributes: Mapping[str, object]) -> Iterator[Config]:
    with as_file(files("migrations")) as scripts:
        config = migration_config(scripts)
        config.attributes.update(attributes)
        config.attributes["connection"] = connection
        yield config


def migration_config(scripts: Path) -> Config:
    """Make Alembic's settings for the migrations folder, wherever it is installed."""
    config = Config()
    config.set_main_option("script_location", str(scripts).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    return config
