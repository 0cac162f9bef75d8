"""Database sessions for reading and writing on SQLite or PostgreSQL, and the check that it is the same database."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from sqlalchemy import URL, Connection, Engine
from sqlalchemy.orm import Session

from engine.core.errors import TidegateError
from service.storage.database import migrations
from service.storage.database.sqlite import file_identity, make_sqlite_engine, writing_sqlite_engine

if TYPE_CHECKING:  # the driver of PostgreSQL is loaded where a database of it is opened
    from service.storage.database.postgres import ServiceClaim

BUSY_TIMEOUT_S = 5.0
ANSWER_TIMEOUT_S = 10.0


class DatabaseInUseError(TidegateError):
    """Another service uses this database."""

    code: ClassVar[str] = "database_in_use"


class Database:
    """Opens read sessions and exclusive write sessions; called from any thread.

    A write session holds the write lock from begin to end (``BEGIN IMMEDIATE`` in SQLite, an advisory lock in
    PostgreSQL): the audit chain reads its last link and appends the next under one lock, and no transaction fails
    halfway because of a lock.

    Parameters
    ----------
    place
        Path of an SQLite file, or URL of a PostgreSQL database.
    busy_timeout_s
        Longest wait for the write lock or a free connection [s].
    answer_timeout_s
        Time limit of one statement in PostgreSQL [s]; None, for migrations and backups, sets no limit.
    """

    def __init__(
        self,
        place: Path | URL,
        *,
        busy_timeout_s: float = BUSY_TIMEOUT_S,
        answer_timeout_s: float | None = ANSWER_TIMEOUT_S,
    ) -> None:
        self.place = place
        self._identity: tuple[object, ...] | None = None
        self._claim: ServiceClaim | None = None
        self._is_claim_ours = False
        self._engine: Engine
        if isinstance(place, Path):
            self._engine = make_sqlite_engine(place, busy_timeout_s=busy_timeout_s)
            self._reading_engine, self._writing_engine = self._engine, writing_sqlite_engine(self._engine)
        else:
            from service.storage.database.postgres import make_postgres_engine, reading_postgres_engine

            self._engine = make_postgres_engine(place, busy_timeout_s=busy_timeout_s, answer_timeout_s=answer_timeout_s)
            self._reading_engine, self._writing_engine = reading_postgres_engine(self._engine), self._engine

    @property
    def is_postgresql(self) -> bool:
        """Whether this is a PostgreSQL database rather than an SQLite file."""
        return isinstance(self.place, URL)

    @property
    def path(self) -> Path:
        """The SQLite file; raises TypeError for PostgreSQL."""
        if isinstance(self.place, URL):
            msg = "a PostgreSQL database is no file"
            raise TypeError(msg)
        return self.place

    def log_bytes(self) -> int:
        """Return the size of SQLite's write-ahead log, which grows while a reader stays; 0 for PostgreSQL."""
        if self.is_postgresql:
            return 0
        try:
            return self.path.with_name(f"{self.path.name}-wal").stat().st_size
        except OSError:
            return 0

    def twin(self, *, busy_timeout_s: float, answer_timeout_s: float | None) -> "Database":
        """Return a second `Database` for the same place with other time-outs [s]; it shares identity and claim."""
        other = Database(self.place, busy_timeout_s=busy_timeout_s, answer_timeout_s=answer_timeout_s)
        other._identity, other._claim = self._identity, self._claim
        return other

    @contextmanager
    def read(self) -> Iterator[Session]:
        """Open a session whose transaction sees one snapshot; raise SQLAlchemyError if the database fails."""
        with Session(self._reading_engine) as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """Open a session with the write lock; commit at the end, roll back on an exception."""
        with Session(self._writing_engine) as session, session.begin():
            if self.is_postgresql:
                from service.storage.database.postgres import take_write_lock

                take_write_lock(session.connection())
            yield session

    def claim(self) -> None:
        """Reserve a PostgreSQL database for this service until `close`; for SQLite the data folder's lock does that.

        Raises
        ------
        DatabaseInUseError
            Another service uses it; each would mark the other's running session as interrupted.
        """
        if isinstance(self.place, Path):
            return
        from service.storage.database.postgres import ServiceClaim

        claim = ServiceClaim(self.place)
        try:
            is_taken = claim.take()
        except BaseException:
            claim.close()
            raise
        if not is_taken:
            claim.close()
            msg = "another Tidegate service runs with this database: each needs one of its own"
            raise DatabaseInUseError(msg)
        self._claim, self._is_claim_ours = claim, True

    def trouble(self) -> str | None:
        """Return a sentence if this is no longer the database that was opened; None if it is.

        Raises
        ------
        SQLAlchemyError
            The server does not answer.
        """
        found = self._read_identity()
        if found is None:
            return "the database's server is a standby" if self.is_postgresql else "the database's file was taken away"
        if self._identity is None:
            self._identity = found
        if found != self._identity:
            return "another database lies in the place of the one that was opened"
        if self._claim is not None and not self._claim.take():
            return "another Tidegate service may have the database: this one lost its lock on it"
        return None

    def _read_identity(self) -> tuple[object, ...] | None:
        if isinstance(self.place, Path):
            return file_identity(self.place)
        from service.storage.database.postgres import server_identity

        with self._reading_engine.connect() as connection:
            return server_identity(connection)

    def migrate(self, revision: str = "head") -> None:
        """Upgrade the tables to a revision, or create them, and record the identity of this database."""
        with closing(self._without_timeouts()) as database, database.connect() as connection:
            migrations.upgrade(connection, revision)
        self._identity = None
        self.trouble()

    def downgrade(self, revision: str) -> None:
        """Downgrade the tables to an older revision; data without a place there is lost.

        See :func:`service.storage.database.migrations.losses`.
        """
        with closing(self._without_timeouts()) as database, database.connect() as connection:
            migrations.downgrade(connection, revision)

    def _without_timeouts(self) -> "Database":
        return self.twin(busy_timeout_s=BUSY_TIMEOUT_S, answer_timeout_s=None)

    def connect(self) -> Connection:
        """Open a plain connection, for migrations and schema checks."""
        return self._engine.connect()

    def close(self) -> None:
        """Release the claim and close all connections; the last one to an SQLite file checkpoints the WAL."""
        if self._claim is not None and self._is_claim_ours:
            self._claim.close()
        self._engine.dispose()
