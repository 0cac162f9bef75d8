"""Schema revisions: upgrade, downgrade, the status of a database, and the data that a downgrade would lose.

Both databases have transactional DDL: a migration is applied completely or not at all.
"""

import functools
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from sqlalchemy import Column, Connection, MetaData, Table, and_, func, inspect, select, sql, true

from engine.core.errors import TidegateError
from service.storage.database.sqlite import make_sqlite_engine

# Alembic is imported where tables are changed: a third of a second, of no use to a start that finds them as they are.
if TYPE_CHECKING:
    from alembic.config import Config
    from alembic.script import Script

VERSION_TABLE = "alembic_version"
BASE = "base"
HEAD = "head"


class MigrationError(TidegateError):
    """The tables cannot be migrated to that revision."""

    code: ClassVar[str] = "migration_refused"


@dataclass(frozen=True, slots=True, kw_only=True)
class SchemaStatus:
    """The revision of a database's tables; ``revision`` is None for a database without tables."""

    revision: str | None
    head: str
    ahead: tuple[str, ...]
    """Revisions to apply, oldest first."""


def schema_status(connection: Connection) -> SchemaStatus:
    """Return the revision of the tables and the revisions to apply.

    Raises
    ------
    MigrationError
        The tables were made by a newer version, or by one before 1.0.0.
    """
    is_own = not connection.in_transaction()
    has_tables = inspect(connection).has_table(VERSION_TABLE)
    named: sql.Select[str] = sql.select(sql.column("version_num")).select_from(sql.table(VERSION_TABLE))
    revision = connection.scalar(named) if has_tables else None
    if is_own:
        connection.rollback()
    scripts = _revisions()
    if revision is not None and revision not in scripts:
        msg = (
            f"the database is at revision {revision}, made by a newer version of Tidegate, or by one before 1.0.0; "
            f"this version supports up to {scripts[-1]}"
        )
        raise MigrationError(msg)
    ahead = scripts if revision is None else scripts[scripts.index(revision) + 1 :]
    return SchemaStatus(revision=revision, head=scripts[-1], ahead=tuple(ahead))


def titles() -> dict[str, str]:
    """Return the title of each revision, oldest first."""
    return {script.revision: script.doc.splitlines()[0] for script in _scripts()}


def upgrade(connection: Connection, revision: str) -> None:
    """Upgrade to a revision, within the connection's transaction if one has begun."""
    if not connection.in_transaction():
        status = schema_status(connection)  # raises MigrationError for tables of a newer version
        if revision == HEAD and not status.ahead:
            return
    from alembic import command

    with _config(connection) as config:
        command.upgrade(config, revision)


def downgrade(connection: Connection, revision: str) -> None:
    """Downgrade to a revision; data without a place there is lost, see `losses`."""
    from alembic import command

    schema_status(connection)
    with _config(connection) as config:
        command.downgrade(config, revision)


def losses(connection: Connection, revision: str) -> list[str]:
    """List the tables and columns whose rows or values do not exist at an older revision, with counts."""
    current, target = MetaData(), _tables_at(revision)
    current.reflect(connection)
    found: list[str] = []
    for table in current.sorted_tables:
        if table.name == VERSION_TABLE:
            continue
        older = target.tables.get(table.name)
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
    has_value = and_(column.is_not(None), true() if default is None else column != default)
    count = connection.scalar(select(func.count()).select_from(table).where(has_value)) or 0
    return [f"{table.name}.{column.name}: {count} values"] if count else []


def _default_of(column: Column[object]) -> str | None:
    """Return a text column's default, which PostgreSQL reports as `'{}'::text`; None if there is none."""
    shown = getattr(column.server_default, "arg", None)
    text = "" if shown is None else str(shown)
    return text.split("'")[1] if text.count("'") >= 2 else None


def _tables_at(revision: str) -> MetaData:
    """Return the tables of a revision, read from an empty temporary database."""
    tables = MetaData()
    with tempfile.TemporaryDirectory() as folder:
        engine = make_sqlite_engine(Path(folder) / "empty.db", busy_timeout_s=1.0)
        try:
            with engine.connect() as connection:
                if revision != BASE:
                    upgrade(connection, revision)
                tables.reflect(connection)
        finally:
            engine.dispose()
    return tables


def _revisions() -> list[str]:
    """Return the names of all revisions, oldest first: their files are numbered."""
    scripts = (one.name for one in (files("migrations") / "versions").iterdir())
    return sorted(name.partition("_")[0] for name in scripts if name[:1].isdigit() and name.endswith(".py"))


@functools.cache
def _scripts() -> "Sequence[Script]":
    """Return all revisions, oldest first; their files are loaded once per process."""
    from alembic.script import ScriptDirectory

    with as_file(files("migrations")) as folder:
        return tuple(reversed(list(ScriptDirectory.from_config(migration_config(folder)).walk_revisions())))


@contextmanager
def _config(connection: Connection) -> "Iterator[Config]":
    with as_file(files("migrations")) as scripts:
        config = migration_config(scripts)
        config.attributes["connection"] = connection
        yield config


def migration_config(scripts: Path) -> "Config":
    """Return Alembic's configuration for a migrations folder."""
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(scripts).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    return config
