"""Audit rows as JSON lines in files that rotate, for the site's log collector (rsyslog, or any other that reads files).

A file is named after its first row and never renamed, so that a collector cannot miss one between two names. The audit
table is the spool, the newest file's last whole line the position: a restart goes on behind it, and what a failed write
left out is written at the next turn. After a power failure a line can stand twice; each has its row's number and hash,
by which a repository recognises it.
"""

import json
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from service.storage.audit.chain import SYSTEM, Event, Link
from service.storage.audit.check import row_at
from service.storage.audit.export import MAX_LINE_CHARACTERS, json_lines
from service.storage.audit.verification import head_sequence, read_links
from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow

logger = logging.getLogger(__name__)

BATCH_ROWS = 500
NAME = "audit-{:012d}.jsonl"
FILE_MODE, FOLDER_MODE = 0o640, 0o750
"""Readable by the group, for a collector with an account of its own."""
FAILED = "audit.log_failed"
RESUMED = "audit.log_resumed"


class Position(NamedTuple):
    """Sequence and hash of the newest row in the file."""

    sequence: int
    hash: str


class AuditLogFile:
    """Appends new audit rows to the newest file of a folder; ``update`` is called from one thread.

    Parameters
    ----------
    folder
        Made if it is not there; its parent must be.
    max_bytes, kept_files
        A new file is begun before one grows beyond ``max_bytes``; the oldest are removed.
    after
        Sequence of the row behind which the first file begins.
    with_patients
        False leaves out the details that name a patient.
    """

    def __init__(
        self,
        *,
        database: Database,
        folder: Path,
        max_bytes: int,
        kept_files: int,
        write: Callable[[Event], None],
        after: int,
        with_patients: bool = False,
    ) -> None:
        self._database = database
        self._folder = folder
        self._max_bytes = max_bytes
        self._kept_files = kept_files
        self._write = write
        self._first = after
        self._with_patients = with_patients
        self._written: int | None = None
        self._failed: str | None = None

    @property
    def trouble(self) -> str | None:
        """Why rows wait, and how many, as a sentence; None while all is well."""
        failed = self._failed
        if failed is None:
            return None
        try:
            with self._database.read() as db:
                waiting = head_sequence(db) - (self._written or self._first)
        except SQLAlchemyError:
            return None  # the readiness reports the database's own trouble
        return f"{failed}; {waiting} rows wait"

    @property
    def written(self) -> int | None:
        """Sequence of the newest row in the files; None before the first update."""
        return self._written

    def update(self) -> None:
        """Append the rows that are not in the files; raise SQLAlchemyError if the database fails."""
        try:
            if self._written is None:
                self._written = self._position()
            while links := self._next_links(self._written):
                self._append(links)
        except OSError as error:
            self._written = None  # what reached the file is read again
            self._report(f"the audit cannot be written to {self._folder}: {error.strerror or error}")
            return
        if self._failed is not None:
            self._failed = None
            self._write(Event(actor=SYSTEM, action=RESUMED, detail={"sequence": self._written}))

    def _next_links(self, after: int) -> list[Link]:
        with self._database.read() as db:
            return read_links(db, after, BATCH_ROWS)

    def _append(self, links: list[Link]) -> None:
        with self._database.read() as db:
            lines = [line.encode() for line in json_lines(db, links, with_patients=self._with_patients)]
        path = self._newest()
        size = 0 if path is None else path.stat().st_size
        for link, line in zip(links, lines, strict=True):
            if path is None or (size and size + len(line) > self._max_bytes):
                path, size = self._folder / NAME.format(link.sequence), 0
            descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, FILE_MODE)
            with os.fdopen(descriptor, "ab") as file:
                file.write(line)
            size += len(line)
            self._written = link.sequence
        for old in self._files()[: -self._kept_files]:
            old.unlink(missing_ok=True)

    def _files(self) -> list[Path]:
        return sorted(self._folder.glob(NAME.replace("{:012d}", "*")))

    def _newest(self) -> Path | None:
        self._folder.mkdir(mode=FOLDER_MODE, exist_ok=True)
        return next(reversed(self._files()), None)

    def _position(self) -> int:
        """Return the sequence to go on behind; if the file's last row is not the database's, a backup was restored."""
        newest = self._newest()
        last = None if newest is None else _last_row(newest)
        if last is None:
            return self._first
        with self._database.read() as db:
            row = row_at(db, last.sequence)
            if row is not None and row.hash == last.hash:
                return last.sequence
            restored = select(AuditRow.sequence).where(
                AuditRow.session_id.is_(None), AuditRow.action == "backup.restored"
            )
            found = db.scalar(restored.order_by(AuditRow.sequence.desc()).limit(1))
        logger.warning("row %d in %s is not the database's: another audit lies there", last.sequence, self._folder)
        return self._first if found is None else found - 1

    def _report(self, trouble: str) -> None:
        is_new, self._failed = self._failed is None, trouble
        if is_new:
            logger.error("%s", trouble)
            self._write(Event(actor=SYSTEM, action=FAILED, outcome="failed", detail={"detail": trouble}))


def _last_row(path: Path) -> Position | None:
    """Return the file's last whole row, None without one; a torn line at its end is ended, to be told from the next."""
    with path.open("r+b") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - MAX_LINE_CHARACTERS))
        lines = file.read().split(b"\n")
        if lines[-1]:
            file.write(b"\n")
    for line in reversed(lines):
        try:
            fields = json.loads(line)
            return Position(sequence=int(fields["sequence"]), hash=str(fields["hash"]))
        except (ValueError, KeyError, TypeError):
            continue
    return None
