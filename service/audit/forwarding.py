"""Passes the audit on, as it is written, to a server that nobody here can change anything on.

The audit's table is the spool: what was passed on is a number in a small file, so that hours without the server cost
nothing but the wait. Syslog has no answer, so that "passed on" means: the other machine acknowledged every byte, and
was still there a second later. What is younger when a connection, or we, break down is sent again; each message carries
its row's number and seal, by which a repository knows it for the same one.
"""

import json
import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from engine.clock import NS_PER_S, Clock
from engine.whole_files import write_whole
from service.audit.chain import SYSTEM, Event, Link, canonical_json
from service.audit.check import row_at
from service.audit.dicom_message import Source, audit_message
from service.audit.patients import patients_of
from service.audit.syslog import framed
from service.audit.walk import head_sequence, read_links
from service.db.engine import Database
from service.db.models import AuditRow

logger = logging.getLogger(__name__)

BATCH_ROWS = 64
LOOK_S = 0.25
SETTLED_S = 1.0
FIRST_WAIT_S = 0.5
LONGEST_WAIT_S = 60.0
FAILED = "audit.forwarding_failed"
RESUMED = "audit.forwarding_resumed"
POSITION_NAME = "audit-forwarded.json"


class Connection(Protocol):
    """A way to the server."""

    def look(self) -> None:
        """Raise OSError where the server has gone."""

    def send(self, messages: list[bytes]) -> None:
        """Send; return once the other machine has everything."""

    def end(self) -> None:
        """Part in order: raise OSError unless the server has read everything."""

    def close(self) -> None:
        """Drop it."""


class Position(NamedTuple):
    """The newest row that was passed on."""

    sequence: int
    hash: str


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sent:
    """A batch the other machine has, and since when."""

    position: Position
    at_ns: int


class PositionFile:
    """Keeps how far the passing on has come; whole, or as it was before."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self) -> Position | None:
        """Return the position, None before the first."""
        try:
            said = json.loads(self._path.read_text(encoding="utf-8"))
            return Position(sequence=int(said["sequence"]), hash=str(said["hash"]))
        except FileNotFoundError:
            return None
        except (ValueError, KeyError, TypeError):
            logger.warning("%s cannot be read: the audit is passed on from this start on", self._path.name)
            return None

    def write(self, position: Position) -> None:
        """Keep a position."""
        text = f"{canonical_json(position._asdict())}\n".encode()
        write_whole(self._path, lambda file: file.write(text))


class AuditForwarder:
    """Follows the audit and passes its rows on, in a thread of its own."""

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
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="tidegate-forwarding", daemon=True)

    @property
    def trouble(self) -> str | None:
        """Say for how long nothing has come through, and how much waits."""
        since_ns, settled = self._failing_since_ns, self._settled
        if since_ns is None:
            return None
        try:
            with self._database.read() as db:
                waiting = head_sequence(db) - (settled or 0)
        except SQLAlchemyError:
            return None  # told as the database's own trouble
        seconds = (self._clock.now_ns() - since_ns) // NS_PER_S
        return f"the audit has not been passed on for {seconds} s, {waiting} rows wait: {self._why}"

    @property
    def passed_on(self) -> int | None:
        """The newest row that surely came through; None before the first look."""
        return self._settled

    def begin(self) -> None:
        """Start to pass on."""
        self._thread.start()

    def end(self, timeout_s: float) -> None:
        """Pass on what is left where the server is there, and end."""
        self._ending.set()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        wait_s = 0.0
        while not self._ending.wait(wait_s):
            wait_s = self.turn()
        self._part()

    def turn(self) -> float:
        """Pass on what is there; return how long to wait for more [s]."""
        try:
            links = self._next_links()
            if self._connection is not None:
                self._settle(self._connection)
            if not links:
                return LOOK_S
            self._pass_on(links)
        except SQLAlchemyError:
            return LONGEST_WAIT_S / 10  # the database's own trouble is told elsewhere
        except OSError as error:
            return self._failed(error)
        self._succeeded()
        return 0.0

    def _next_links(self) -> list[Link]:
        if self._settled is None:
            self._settled = self._sent = self._found_position()
        with self._database.read() as db:
            return read_links(db, self._sent, BATCH_ROWS)

    def _found_position(self) -> int:
        """Go on where the last one stopped; where that row is not there any more, a backup was restored."""
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

    def _pass_on(self, links: list[Link]) -> None:
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
        """Count as passed on what the server has had for a while, and not gone away since."""
        connection.look()
        until_ns = self._clock.now_ns() - round(SETTLED_S * NS_PER_S)
        newest: Position | None = None
        while self._in_flight and self._in_flight[0].at_ns <= until_ns:
            newest = self._in_flight.popleft().position
        if newest is not None:
            self._keep(newest)

    def _keep(self, position: Position) -> None:
        self._positions.write(position)
        self._settled = position.sequence

    def _failed(self, error: OSError) -> float:
        """Begin anew after the last row that surely came through; wait longer each time."""
        was_there = self._connection is not None
        self._drop()
        if was_there and self._failing_since_ns is None:
            return 0.0  # servers restart: only one that is not back at once is an outage
        self._why = str(error.strerror or error)
        if self._failing_since_ns is None:
            self._failing_since_ns = self._clock.now_ns()
            logger.warning("the audit cannot be passed on: %s", self._why)
            self._tell(Event(actor=SYSTEM, action=FAILED, outcome="failed", detail={"detail": self._why}))
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
            self._tell(Event(actor=SYSTEM, action=RESUMED, detail={"after_s": round(seconds, 1)}))

    def _tell(self, event: Event) -> None:
        try:
            self._write(event)
        except SQLAlchemyError:
            logger.warning("%s could not be written down", event.action)

    def _part(self) -> None:
        """Send the last rows and part in order: a server that says good-bye has read everything."""
        if self._connection is None:
            return
        try:
            while links := self._next_links():
                self._pass_on(links)
            self._connection.end()
            if self._in_flight:
                self._keep(self._in_flight[-1].position)
        except (OSError, SQLAlchemyError) as error:
            logger.info("the audit's last rows are passed on at the next start (%s)", type(error).__name__)
        self._drop()
