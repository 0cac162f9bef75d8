"""Occupy the threads and database connections of a service."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager

import anyio.to_thread
from sqlalchemy.orm import Session

from service.core.schemas.sessions import SessionPage
from service.storage.database.tables import SessionRow

THREADS = 40
"""What anyio gives an event loop for all calls together."""
CONNECTIONS = 15
"""What SQLAlchemy's pool gives out at most."""
LONGEST_S = 30.0
"""Until a test that would hang is given up; what blocks it blocks for twice as long."""


class Jam:
    """Blocks whatever enters until it is over."""

    def __init__(self) -> None:
        self._over = threading.Event()
        self._lock = threading.Lock()
        self.inside = 0

    def page(self, *_asked: object) -> SessionPage:
        self._block()
        return SessionPage(items=[], next_cursor=None)

    def rows(self, db: Session, *_asked: object) -> tuple[list[SessionRow], None]:
        db.connection()
        self._block()
        return [], None

    def then(self, find: Callable) -> Callable:
        def find_at_last(db: Session, *asked: object) -> object:
            self.rows(db)
            return find(db, *asked)

        return find_at_last

    def _block(self) -> None:
        with self._lock:
            self.inside += 1
        assert self._over.wait(2 * LONGEST_S)

    def end(self) -> None:
        self._over.set()


@contextmanager
def reads(client, count: int) -> Iterator[tuple[Jam, ThreadPoolExecutor]]:
    """Let so many lists of sessions be asked for, once the block has put a jam in their way."""
    client.headers_as("A. Therapist")
    jam = Jam()
    with ThreadPoolExecutor(count + 1) as pool:
        try:
            yield jam, pool
        finally:
            jam.end()


def ask_for_lists(client, pool: ThreadPoolExecutor, count: int) -> list[Future]:
    return [pool.submit(client.get, "/api/v1/sessions") for _ in range(count)]


def waiting_for_a_thread(client) -> int:
    async def look() -> int:
        return anyio.to_thread.current_default_thread_limiter().statistics().tasks_waiting

    return client.portal.call(look)
