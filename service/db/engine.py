"""The SQLite file: WAL, full synchronisation, foreign keys, and migrations on first start."""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import as_file, files
from pathlib import Path

from alembic import command
from alembic.config import Config
from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.orm import Session

BEGIN_OPTION = "tidegate_begin"


class Database:
    """Sessions to read with and sessions to write with.

    A writing session takes the write lock at once (``BEGIN IMMEDIATE``): the audit chain reads its last link and adds
    the next one under the same lock, and nobody is told "locked" halfway through.
    """

    def __init__(self, path: Path, *, busy_timeout_s: float = 5.0) -> None:
        self.path = path
        self._engine = _make_engine(path, busy_timeout_s)
        self._writing_engine = self._engine.execution_options(**{BEGIN_OPTION: "BEGIN IMMEDIATE"})

    @contextmanager
    def read(self) -> Iterator[Session]:
        """Open a session that sees one moment of the database."""
        with Session(self._engine) as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """Open a session that holds the write lock; committed at the end, or rolled back on an error."""
        with Session(self._writing_engine) as session, session.begin():
            yield session

    def migrate(self, revision: str = "head") -> None:
        """Bring the tables to a revision, making them on first start."""
        with as_file(files("migrations")) as scripts:
            config = migration_config(scripts)
            with self._engine.connect() as connection:
                config.attributes["connection"] = connection
                command.upgrade(config, revision)

    def downgrade(self, revision: str) -> None:
        """Go back to an older revision."""
        with as_file(files("migrations")) as scripts:
            config = migration_config(scripts)
            with self._engine.connect() as connection:
                config.attributes["connection"] = connection
                command.downgrade(config, revision)

    def connect(self) -> Connection:
        """Open a plain connection: for schema checks."""
        return self._engine.connect()

    def close(self) -> None:
        """Give all connections back; the last one checkpoints the WAL."""
        self._engine.dispose()


def migration_config(scripts: Path) -> Config:
    """Make Alembic's settings for the migrations folder, wherever it is installed."""
    config = Config()
    config.set_main_option("script_location", str(scripts).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    return config


def _make_engine(path: Path, busy_timeout_s: float) -> Engine:
    engine = create_engine(f"sqlite:///{path}", connect_args={"timeout": busy_timeout_s, "check_same_thread": False})

    @event.listens_for(engine, "connect")
    def _prepare(connection: sqlite3.Connection, _record: object) -> None:
        # The driver's own transaction handling commits before DDL and begins late; we say BEGIN ourselves.
        connection.isolation_level = None
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=FULL")
        connection.execute("PRAGMA foreign_keys=ON")
        connection.execute(f"PRAGMA busy_timeout={int(busy_timeout_s * 1000)}")

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        connection.exec_driver_sql(connection.get_execution_options().get(BEGIN_OPTION, "BEGIN"))

    return engine
