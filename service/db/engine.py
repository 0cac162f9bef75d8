"""The database, on SQLite or PostgreSQL: sessions to read and to write with, and whether it is still there."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import ClassVar

from sqlalchemy import URL, Connection, Engine
from sqlalchemy.orm import Session

from engine.errors import TidegateError
from service.db import migrating
from service.db.claim import ServiceClaim
from service.db.postgres import make_postgres_engine, reading_postgres_engine, server_identity, take_write_lock
from service.db.sqlite import file_identity, make_sqlite_engine, writing_sqlite_engine

BUSY_TIMEOUT_S = 5.0
ANSWER_TIMEOUT_S = 10.0


class DatabaseInUseError(TidegateError):
    """Another service runs with this database."""

    code: ClassVar[str] = "database_in_use"


class Database:
    """Sessions to read with and sessions to write with.

    A writing session is the only one from its begin to its end (``BEGIN IMMEDIATE`` in SQLite, one advisory lock in
    PostgreSQL): the audit chain reads its last link and adds the next one under the same lock, and nobody is told
    "locked" halfway through.

    Parameters
    ----------
    place
        A file (SQLite), or the URL of a PostgreSQL database.
    busy_timeout_s
        How long is waited for another's lock, or for a free connection.
    answer_timeout_s
        How long PostgreSQL may take for one statement; None, for migrations and backups, as long as it takes.
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
            self._engine = make_postgres_engine(place, busy_timeout_s=busy_timeout_s, answer_timeout_s=answer_timeout_s)
            self._reading_engine, self._writing_engine = reading_postgres_engine(self._engine), self._engine

    @property
    def is_postgresql(self) -> bool:
        """Whether this is a PostgreSQL server's database, and not a file."""
        return isinstance(self.place, URL)

    @property
    def path(self) -> Path:
        """The file; of SQLite alone."""
        if isinstance(self.place, URL):
            msg = "a PostgreSQL database is no file"
            raise TypeError(msg)
        return self.place

    def twin(self, *, busy_timeout_s: float, answer_timeout_s: float | None) -> "Database":
        """Open the same database once more, with other patience."""
        other = Database(self.place, busy_timeout_s=busy_timeout_s, answer_timeout_s=answer_timeout_s)
        other._identity, other._claim = self._identity, self._claim
        return other

    @contextmanager
    def read(self) -> Iterator[Session]:
        """Open a session that sees one moment of the database."""
        with Session(self._reading_engine) as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """Open a session that holds the write lock; committed at the end, or rolled back on an error."""
        with Session(self._writing_engine) as session, session.begin():
            if self.is_postgresql:
                take_write_lock(session.connection())
            yield session

    def claim(self) -> None:
        """Have a server's database for this service alone until it is closed; a file is its data folder's.

        Raises
        ------
        DatabaseInUseError
            A service with another data folder has it: each would end the other's session as interrupted.
        """
        if isinstance(self.place, Path):
            return
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
        """Say whether this is no longer the database that was opened, in words; None where it is.

        Raises
        ------
        SQLAlchemyError
            The server does not answer.
        """
        found = self._look()
        if found is None:
            return "the database's server is a standby" if self.is_postgresql else "the database's file was taken away"
        if self._identity is None:
            self._identity = found
        if found != self._identity:
            return "another database lies in the place of the one that was opened"
        if self._claim is not None and not self._claim.take():
            return "another Tidegate service may have the database: this one lost its lock on it"
        return None

    def _look(self) -> tuple[object, ...] | None:
        if isinstance(self.place, Path):
            return file_identity(self.place)
        with self._reading_engine.connect() as connection:
            return server_identity(connection)

    def migrate(self, revision: str = "head", **attributes: object) -> None:
        """Bring the tables to a revision, making them on first start; what there is, is from now on this database."""
        with closing(self._patient()) as patient, patient.connect() as connection:
            migrating.upgrade(connection, revision, attributes)
        self._identity = None
        self.trouble()

    def downgrade(self, revision: str, **attributes: object) -> None:
        """Go back to an older revision, whatever is lost by it; see :func:`service.db.migrating.losses`."""
        with closing(self._patient()) as patient, patient.connect() as connection:
            migrating.downgrade(connection, revision, attributes)

    def _patient(self) -> "Database":
        return self.twin(busy_timeout_s=BUSY_TIMEOUT_S, answer_timeout_s=None)

    def connect(self) -> Connection:
        """Open a plain connection: for migrations and schema checks."""
        return self._engine.connect()

    def close(self) -> None:
        """Give all connections back; the last one to a file checkpoints the WAL."""
        if self._claim is not None and self._is_claim_ours:
            self._claim.close()
        self._engine.dispose()
