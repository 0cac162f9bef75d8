"""Exclusive use of a PostgreSQL database by one service: an advisory lock held by a dedicated connection.

The connection can be lost unnoticed (server restart, administrator, network). The service therefore checks periodically
that the lock is still held, and takes it again if it was lost.
"""

import contextlib
import threading
from dataclasses import dataclass

from sqlalchemy import URL, Connection, text
from sqlalchemy.exc import SQLAlchemyError

from service.storage.database.postgres import make_postgres_engine

SERVICE_LOCK = 0x7469646573657276  # "tideserv": held for as long as a service runs with this database
ANSWER_TIMEOUT_S = 1.0
"""Short, because the session's writer waits for it and must report a server that does not answer."""

TAKE = text("SELECT pg_try_advisory_lock(:lock)")
BACKEND = text("SELECT pid, backend_start FROM pg_stat_activity WHERE pid = pg_backend_pid()")
END_BACKEND = text("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid = :pid AND backend_start = :start")


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
