"""SQLite engine: WAL, synchronous=FULL, foreign keys, and write transactions that begin with the lock."""

import contextlib
import os
import sqlite3
from pathlib import Path

from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.engine.interfaces import Dialect

BEGIN_OPTION = "tidegate_begin"
MS_PER_S = 1000
LOG_BYTES = 16 * 1024 * 1024
"""Size to which the write-ahead log shrinks once its readers have moved on; while one stays, it grows."""


def make_sqlite_engine(path: Path, *, busy_timeout_s: float) -> Engine:
    """Make an engine for a file, created with mode 0600 if missing; ``busy_timeout_s`` bounds waits for a lock [s]."""
    engine = create_engine(
        f"sqlite:///{path}",
        connect_args={"timeout": busy_timeout_s, "check_same_thread": False},
        pool_timeout=busy_timeout_s,
        hide_parameters=True,  # error messages must not contain row data
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
        # The driver's own transaction handling commits before DDL and begins late; BEGIN is issued below.
        connection.isolation_level = None
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=FULL")
        connection.execute(f"PRAGMA journal_size_limit={LOG_BYTES}")
        connection.execute("PRAGMA foreign_keys=ON")
        connection.execute(f"PRAGMA busy_timeout={int(busy_timeout_s * MS_PER_S)}")

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        connection.exec_driver_sql(connection.get_execution_options().get(BEGIN_OPTION, "BEGIN"))

    return engine


def writing_sqlite_engine(engine: Engine) -> Engine:
    """Return the engine with transactions that take the write lock at their begin."""
    return engine.execution_options(**{BEGIN_OPTION: "BEGIN IMMEDIATE"})


def file_identity(path: Path) -> tuple[int, int] | None:
    """Return device and inode of the file; None if it is missing: writes to a deleted file would be lost."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino
