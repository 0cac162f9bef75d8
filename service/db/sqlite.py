"""The SQLite file: WAL, full synchronisation, foreign keys, and a write lock taken at once."""

import contextlib
import os
import sqlite3
from pathlib import Path

from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.engine.interfaces import Dialect

BEGIN_OPTION = "tidegate_begin"
MS_PER_S = 1000


def make_sqlite_engine(path: Path, *, busy_timeout_s: float) -> Engine:
    """Open a file, made where it is missing; a connection waits so long for others' write lock."""
    engine = create_engine(
        f"sqlite:///{path}",
        connect_args={"timeout": busy_timeout_s, "check_same_thread": False},
        pool_timeout=busy_timeout_s,
        hide_parameters=True,  # an error that is told somewhere must not tell a row
    )

    @event.listens_for(engine, "do_connect")
    def _make_private(_dialect: Dialect, _record: object, _args: object, _named: object) -> None:
        # A new file is its owner's alone; SQLite gives the files beside it the same mode. One that is there is never
        # opened here: to close it would drop all locks that this process has on it, and another process that ends
        # would take the write-ahead log away under us.
        with contextlib.suppress(OSError):
            os.close(os.open(path, os.O_RDONLY | os.O_CREAT | os.O_EXCL, 0o600))

    @event.listens_for(engine, "connect")
    def _prepare(connection: sqlite3.Connection, _record: object) -> None:
        # The driver's own transaction handling commits before DDL and begins late; we say BEGIN ourselves.
        connection.isolation_level = None
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=FULL")
        connection.execute("PRAGMA foreign_keys=ON")
        connection.execute(f"PRAGMA busy_timeout={int(busy_timeout_s * MS_PER_S)}")

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        connection.exec_driver_sql(connection.get_execution_options().get(BEGIN_OPTION, "BEGIN"))

    return engine


def writing_sqlite_engine(engine: Engine) -> Engine:
    """Return the same engine with transactions that hold the write lock from their begin."""
    return engine.execution_options(**{BEGIN_OPTION: "BEGIN IMMEDIATE"})


def file_identity(path: Path) -> tuple[int, int] | None:
    """Return which file lies there; one that was taken away takes what is written to it along."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino
