"""Forwards audit rows, as they are written, to a syslog server outside the reach of this machine's users.

The audit table is the spool: a small file holds the sequence of the newest forwarded row, so an outage needs no
memory. Syslog has no acknowledgement; a row counts as forwarded when the server's TCP stack has acknowledged every byte
and the connection is still open a second later. Younger rows are sent again after a lost connection or a crash; each
message carries its row's sequence and hash, by which a repository recognises duplicates.
"""

import json
import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from engine.core.clock import NS_PER_S, Clock
from engine.core.files import write_whole
from service.core.periodic import PeriodicWorker
from service.storage.audit.chain import SYSTEM, Event, Link, canonical_json
from service.storage.audit.check import row_at
from service.storage.audit.formats.dicom import Source, audit_message
from service.storage.audit.forwarding.syslog import framed
from service.storage.audit.patients import patients_of
from service.storage.audit.verification import head_sequence, read_links
from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow

logger = logging.getLogger(__name__)

BATCH_ROWS = 64
INTERVAL_S = 0.25
SETTLED_S = 1.0
FIRST_WAIT_S = 0.5
LONGEST_WAIT_S = 60.0
FAILED = "audit.forwarding_failed"
RESUMED = "audit.forwarding_resumed"
POSITION_NAME = "audit-forwarded.json"


class Connection(Protocol):
    """A connection to the syslog server."""

    def check_alive(self) -> None:
        """Raise OSError if the server has closed the connection."""

    def send(self, messages: list[bytes]) -> None:
        """Send; return when the server has acknowledged all bytes, raise OSError otherwise."""

    def end(self) -> None:
        """Close TLS in order; raise OSError unless the server has read everything."""

    def close(self) -> None:
        """Close without waiting."""


class Position(NamedTuple):
    """Sequence and hash of the newest forwarded row."""

    sequence: int
    hash: str


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sent:
    """An acknowledged batch and the time of the acknowledgement [ns]."""

    position: Position
    at_ns: int


class PositionFile:
    """Stores the position in a file that is replaced atomically."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self) -> Position | None:
        """Return the position; None if there is none or it is unreadable."""
        try:
            fields = json.loads(self._path.read_text(encoding="utf-8"))
            return Position(sequence=int(fields["sequence"]), hash=str(fields["hash"]))
        except FileNotFoundError:
            return None
        except (ValueError, KeyError, TypeError):
            logger.warning("%s cannot be read: the audit is passed on from this start on", self._path.name)
            return None

    def write(self, position: Position) -> None:
        """Replace the stored position; raise OSError if that fails."""
        text = f"{canonical_json(position._asdict())}\n".encode()
        write_whole(self._path, text)


class AuditForwarder:
    """Reads new audit rows and sends them to the server, in its own thread."""

    def __init__(
        self,
        *,
        database: Database,
        connect: Callable[[], Connection],
        positions: PositionFile,
        source: Source,
        clock: Clock,
        write: Callable[[Event], None],
        after: int,
        with_patients: bool = False,
    ) -> None:
        self._database = database
        self._connect = connect
        self._positions = positions
        self._source = source
        self._clock = clock
        self._write = write
        self._first = after
        self._with_patients = with_patients
        self._connection: Connection | None = None
        self._settled: int | None = None
        self._sent = 0
        self._in_flight: deque[_Sent] = deque()
        self._failing_since_ns: int | None = None
        self._why = ""
        self._wait_s = FIRST_WAIT_S
        self._worker = PeriodicWorker(
            "tidegate-forwarding", self.turn, interval_s=INTERVAL_S, first_wait_s=0.0, last=self._finish
        )

    @property
    def trouble(self) -> str | None:
        """Duration of the outage and number of waiting rows, as a sentence; None while forwarding works."""
        since_ns, settled = self._failing_since_ns, self._settled
        if since_ns is None:
            return self._worker.trouble
        try:
            with self._database.read() as db:
                waiting = head_sequence(db) - (settled or 0)
        except SQLAlchemyError:
            return None  # the readiness reports the database's own trouble
        seconds = (self._clock.now_ns() - since_ns) // NS_PER_S
        return f"the audit has not been passed on for {seconds} s, {waiting} rows wait: {self._why}"

    @property
    def passed_on(self) -> int | None:
        """Sequence of the newest row that counts as forwarded; None before the first turn."""
        return self._settled

    def start(self) -> None:
        """Start to forward."""
        self._worker.start()

    def stop(self, timeout_s: float) -> None:
        """Forward what is left where the server answers, then stop; wait for that no longer than the timeout [s]."""
        self._worker.stop(timeout_s)

    def turn(self) -> float:
        """Send the waiting rows; return the time to the next turn [s]."""
        try:
            links = self._next_links()
            if self._connection is not None:
                self._settle(self._connection)
            if not links:
                return INTERVAL_S
            self._send(links)
        except SQLAlchemyError:
            return LONGEST_WAIT_S / 10  # readiness reports the database's own trouble
        except OSError as error:
            return self._failed(error)
        self._succeeded()
        return 0.0

    def _next_links(self) -> list[Link]:
        if self._settled is None:
            self._settled = self._sent = self._resume_position()
        with self._database.read() as db:
            return read_links(db, self._sent, BATCH_ROWS)

    def _resume_position(self) -> int:
        """Return the sequence to continue after; if the stored row is gone, a backup was restored."""
        kept = self._positions.read()
        if kept is None:
            return self._first
        with self._database.read() as db:
            row = row_at(db, kept.sequence)
            if row is not None and row.hash == kept.hash:
                return kept.sequence
            restored = select(AuditRow.sequence).where(
                AuditRow.session_id.is_(None), AuditRow.action == "backup.restored"
            )
            found = db.scalar(restored.order_by(AuditRow.sequence.desc()).limit(1))
        logger.warning("the audit's row %d is not the one that was passed on: another audit lies there", kept.sequence)
        return self._first if found is None else found - 1

    def _send(self, links: list[Link]) -> None:
        if self._connection is None:
            self._connection = self._connect()
        self._connection.send(self._messages(links))
        newest = links[-1]
        self._sent = newest.sequence
        position = Position(sequence=newest.sequence, hash=newest.hash)
        self._in_flight.append(_Sent(position=position, at_ns=self._clock.now_ns()))

    def _messages(self, links: list[Link]) -> list[bytes]:
        with self._database.read() as db:
            patients = patients_of(db, (link.session_id for link in links))
        made = []
        for link in links:
            patient = None if link.session_id is None else patients.get(link.session_id)
            text = audit_message(link, source=self._source, patient=patient, with_patients=self._with_patients)
            host_name, process_id = self._source.host_name, self._source.process_id
            made.append(framed(text, at=link.at, host_name=host_name, process_id=process_id))
        return made

    def _settle(self, connection: Connection) -> None:
        """Count batches as forwarded that were acknowledged at least `SETTLED_S` ago on this connection."""
        connection.check_alive()
        until_ns = self._clock.now_ns() - round(SETTLED_S * NS_PER_S)
        newest: Position | None = None
        while self._in_flight and self._in_flight[0].at_ns <= until_ns:
            newest = self._in_flight.popleft().position
        if newest is not None:
            self._save(newest)

    def _save(self, position: Position) -> None:
        self._positions.write(position)
        self._settled = position.sequence

    def _failed(self, error: OSError) -> float:
        """Resume after the newest forwarded row; return the wait [s], which doubles with each failure."""
        was_there = self._connection is not None
        self._drop()
        if was_there and self._failing_since_ns is None:
            return 0.0  # servers restart: only one that is not back at once is an outage
        self._why = str(error.strerror or error)
        if self._failing_since_ns is None:
            self._failing_since_ns = self._clock.now_ns()
            logger.warning("the audit cannot be passed on: %s", self._why)
            self._report(Event(actor=SYSTEM, action=FAILED, outcome="failed", detail={"detail": self._why}))
        wait_s, self._wait_s = self._wait_s, min(LONGEST_WAIT_S, 2 * self._wait_s)
        return wait_s

    def _drop(self) -> None:
        if self._connection is not None:
            self._connection.close()
        self._connection = None
        self._in_flight.clear()
        self._sent = self._settled or 0

    def _succeeded(self) -> None:
        since_ns, self._failing_since_ns, self._wait_s = self._failing_since_ns, None, FIRST_WAIT_S
        if since_ns is not None:
            seconds = (self._clock.now_ns() - since_ns) / NS_PER_S
            self._report(Event(actor=SYSTEM, action=RESUMED, detail={"after_s": round(seconds, 1)}))

    def _report(self, event: Event) -> None:
        try:
            self._write(event)
        except SQLAlchemyError:
            logger.warning("%s could not be written down", event.action)

    def _finish(self) -> None:
        """Send the last rows and close TLS in order: a server that answers has read everything."""
        if self._connection is None:
            return
        try:
            while links := self._next_links():
                self._send(links)
            self._connection.end()
            if self._in_flight:
                self._save(self._in_flight[-1].position)
        except (OSError, SQLAlchemyError) as error:
            logger.info("the audit's last rows are passed on at the next start (%s)", type(error).__name__)
        self._drop()
