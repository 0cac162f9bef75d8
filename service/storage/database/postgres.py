"""PostgreSQL connections with client-side time-outs, and a single writer.

The server's own time-outs do not work once the server or the network has stopped. Every wait is therefore bounded in
the client too, and a connection that timed out is never used again.

Exclusive use of a PostgreSQL database by one service: an advisory lock held by a dedicated connection.

The connection can be lost unnoticed (server restart, administrator, network). The service therefore checks periodically
that the lock is still held, and takes it again if it was lost.
"""

import contextlib
import threading
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import psycopg
from psycopg import sql
from psycopg.abc import PQGen
from sqlalchemy import URL, Connection, Engine, create_engine, event, text
from sqlalchemy.engine.interfaces import DBAPIConnection, Dialect
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.pool import ConnectionPoolEntry

ResultT = TypeVar("ResultT")

WRITE_LOCK = 0x7469646567617465  # "tidegate" in ASCII; a lock of this database alone
CONNECT_TIMEOUT_S = 2
"""Shortest value that the driver accepts [s]."""
KEEPALIVE_S = 5
KEEPALIVES = 3
MS_PER_S = 1000
IDENTITY = text(
    "SELECT (SELECT system_identifier FROM pg_control_system()), "
    "(SELECT oid::bigint FROM pg_database WHERE datname = current_database()), "
    "to_regclass('audit')::oid::bigint, "
    # A standby that took over, or a server brought back to an earlier time, writes a timeline of its own.
    "CASE WHEN pg_is_in_recovery() THEN NULL ELSE left(pg_walfile_name(pg_current_wal_lsn()), 8) END"
)
SERVICE_LOCK = 0x7469646573657276  # "tideserv": held for as long as a service runs with this database
ANSWER_TIMEOUT_S = 1.0
"""Short, because the session's writer waits for it and must report a server that does not answer."""
TAKE = text("SELECT pg_try_advisory_lock(:lock)")
BACKEND = text("SELECT pid, backend_start FROM pg_stat_activity WHERE pid = pg_backend_pid()")
END_BACKEND = text("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid = :pid AND backend_start = :start")


class BoundedConnection(psycopg.Connection[Any]):
    """A connection with a time limit for each answer [s]; None sets no limit."""

    answer_timeout_s: float | None = None

    def wait(self, gen: PQGen[ResultT], interval: float = 0.1, timeout: float | None = None) -> ResultT:
        """Wait for an answer; after the time limit close the connection and raise OperationalError."""
        if timeout is not None or self.answer_timeout_s is None:
            return super().wait(gen, interval, timeout)
        try:
            return super().wait(gen, interval, self.answer_timeout_s)
        except psycopg.errors._WaitTimeout as error:  # noqa: SLF001 - the driver has no public name for it
            # A late answer would be taken for the answer to the next statement.
            self.pgconn.finish()
            msg = f"the database server has not answered for {self.answer_timeout_s:g} s"
            raise psycopg.OperationalError(msg) from error


def make_postgres_engine(url: URL, *, busy_timeout_s: float, answer_timeout_s: float | None) -> Engine:
    """Make an engine; ``answer_timeout_s`` limits each statement [s], None (migrations, backups) sets no limit."""
    engine = create_engine(
        url,
        # With a snapshot, which a site may have as default, the last link would be read as of before the lock.
        isolation_level="READ COMMITTED",
        pool_pre_ping=True,
        pool_timeout=busy_timeout_s,
        hide_parameters=True,  # error messages must not contain row data
        connect_args={
            "connect_timeout": CONNECT_TIMEOUT_S,
            "keepalives_idle": KEEPALIVE_S,
            "keepalives_interval": KEEPALIVE_S,
            "keepalives_count": KEEPALIVES,
            "tcp_user_timeout": 0 if answer_timeout_s is None else int(answer_timeout_s * MS_PER_S),
            "application_name": "tidegate",
            "client_encoding": "utf8",
        },
    )

    @event.listens_for(engine, "do_connect")
    def _connect(
        _dialect: Dialect, _record: ConnectionPoolEntry, args: tuple[Any, ...], named: dict[str, Any]
    ) -> DBAPIConnection:
        connection = BoundedConnection.connect(*args, **named)
        connection.answer_timeout_s = answer_timeout_s
        try:
            _prepare(connection, busy_timeout_s, answer_timeout_s)
        except BaseException:
            connection.close()
            raise
        return cast("DBAPIConnection", connection)

    return engine


def _prepare(connection: BoundedConnection, busy_timeout_s: float, answer_timeout_s: float | None) -> None:
    # Beside what the URL's own `options` say, and over it: a site cannot make a commit less than durable by mistake.
    wanted = {
        "synchronous_commit": "on",
        "lock_timeout": f"{int(busy_timeout_s * MS_PER_S)}ms",
        "statement_timeout": f"{0 if answer_timeout_s is None else int(answer_timeout_s * MS_PER_S)}ms",
        "timezone": "UTC",
    }
    for name, value in wanted.items():
        connection.execute(sql.SQL("SET {} = {}").format(sql.Identifier(name), sql.Literal(value)))
    connection.commit()


def reading_postgres_engine(engine: Engine) -> Engine:
    """Return the engine with read-only snapshot transactions."""
    return engine.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)


def take_write_lock(connection: Connection) -> None:
    """Take the write lock until the transaction ends; a waiting transaction then sees the previous commit."""
    connection.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": WRITE_LOCK})


def server_identity(connection: Connection) -> tuple[object, ...] | None:
    """Return the identity of server, database, audit table and timeline; None for a standby, which is read-only."""
    found = tuple(connection.execute(IDENTITY).one())
    return None if found[-1] is None else found


@dataclass(frozen=True, slots=True, kw_only=True)
class _Backend:
    """The server process of a connection; the start time guards against a reused pid."""

    pid: int
    start: object


class ServiceClaim:
    """The advisory lock and its connection; called from any thread."""

    def __init__(self, url: URL) -> None:
        self._engine = make_postgres_engine(url, busy_timeout_s=ANSWER_TIMEOUT_S, answer_timeout_s=ANSWER_TIMEOUT_S)
        self._connection: Connection | None = None
        self._backend: _Backend | None = None
        self._lock = threading.Lock()

    def take(self) -> bool:
        """Check that the lock is held, or take it; return False if another service has it.

        Raises
        ------
        SQLAlchemyError
            The server does not answer.
        """
        with self._lock:
            return self._is_held() or self._take()

    def _is_held(self) -> bool:
        if self._connection is None:
            return False
        try:
            self._connection.execute(text("SELECT 1"))
            self._connection.commit()
        except SQLAlchemyError:
            self._drop_connection()
            return False
        return True

    def _take(self) -> bool:
        connection = self._engine.connect()
        try:
            is_taken = bool(connection.scalar(TAKE, {"lock": SERVICE_LOCK}))
            if is_taken:
                pid, start = connection.execute(BACKEND).one()
                self._backend = _Backend(pid=pid, start=start)
                self._connection = connection
            else:
                self._end_lost_backend(connection)
            connection.commit()
        finally:
            if self._connection is not connection:
                connection.invalidate()  # it may hold the lock, so it must not return to the pool
                connection.close()
        return is_taken

    def _end_lost_backend(self, connection: Connection) -> None:
        """Terminate the server process of a lost connection, so that the next attempt can take the lock."""
        if self._backend is not None:
            connection.execute(END_BACKEND, {"pid": self._backend.pid, "start": self._backend.start})

    def _drop_connection(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            with contextlib.suppress(SQLAlchemyError):
                connection.invalidate()
            connection.close()

    def close(self) -> None:
        """Close the connection, which releases the lock."""
        with self._lock:
            self._drop_connection()
            self._engine.dispose()
