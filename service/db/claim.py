"""A PostgreSQL database is one service's at a time: a lock of the server's that lives as long as a connection.

The connection can end without anybody hearing of it (a restart, an administrator, the network); whoever uses the
database therefore asks now and then whether the lock is still held, and takes it again where it was lost.
"""

import contextlib
import threading
from dataclasses import dataclass

from sqlalchemy import URL, Connection, text
from sqlalchemy.exc import SQLAlchemyError

from service.db.postgres import make_postgres_engine

SERVICE_LOCK = 0x7469646573657276  # "tideserv": held for as long as a service runs with this database
ANSWER_TIMEOUT_S = 1.0
"""The session's writer asks: it has to tell the gate when nothing answers."""

TAKE = text("SELECT pg_try_advisory_lock(:lock)")
BACKEND = text("SELECT pid, backend_start FROM pg_stat_activity WHERE pid = pg_backend_pid()")
END_BACKEND = text("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid = :pid AND backend_start = :start")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Backend:
    """The server's process behind a connection; a number alone may be another's by now."""

    pid: int
    start: object


class ServiceClaim:
    """The lock, its connection, and the way back to it; of any thread."""

    def __init__(self, url: URL) -> None:
        self._engine = make_postgres_engine(url, busy_timeout_s=ANSWER_TIMEOUT_S, answer_timeout_s=ANSWER_TIMEOUT_S)
        self._connection: Connection | None = None
        self._backend: _Backend | None = None
        self._turn = threading.Lock()

    def take(self) -> bool:
        """Have the lock, as before or once more; False where another service has it.

        Raises
        ------
        SQLAlchemyError
            The server does not answer.
        """
        with self._turn:
            return self._is_held() or self._take()

    def _is_held(self) -> bool:
        if self._connection is None:
            return False
        try:
            self._connection.execute(text("SELECT 1"))
            self._connection.commit()
        except SQLAlchemyError:
            self._let_go()
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
                self._end_our_own(connection)
            connection.commit()
        finally:
            if self._connection is not connection:
                connection.invalidate()  # it may hold the lock, and is never one of the pool's
                connection.close()
        return is_taken

    def _end_our_own(self, connection: Connection) -> None:
        """End what the server still keeps for a connection that we have lost: the next look may find the lock free."""
        if self._backend is not None:
            connection.execute(END_BACKEND, {"pid": self._backend.pid, "start": self._backend.start})

    def _let_go(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            with contextlib.suppress(SQLAlchemyError):
                connection.invalidate()
            connection.close()

    def close(self) -> None:
        """Give the lock back: it ends with the connection."""
        with self._turn:
            self._let_go()
            self._engine.dispose()
