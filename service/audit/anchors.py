"""Heads of the chain kept outside the database, in a file that only grows.

One JSON line a head: when, which row, its seal, why it was written, and the SHA-256 of the line before. Whoever cuts
the newest rows off the database, or seals all of it anew, does not match the lines any more; whoever changes a line
breaks the file's own chain; and each start of the service writes into the audit how far the file reached, so that lines
cut off the file are missed as well. Kept on another machine's share it is out of reach of whoever has the database.

A restored backup ends earlier than the heads before it: the restore says so in a line of its own, and heads before that
line are not held against the database any more. Such lines are told by every verification.
"""

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO, Literal

from service.audit.chain import GENESIS_HASH, canonical_json
from service.audit.walk import Head
from service.db.base import utc_text

AnchorKind = Literal["start", "stop", "session", "time", "restore"]
TAIL_BYTES = 65_536
MAX_LINE_BYTES = 4096
NOTE_CHARACTERS = 200


@dataclass(frozen=True, slots=True, kw_only=True)
class Anchor:
    """One line of the file."""

    at: str
    sequence: int
    hash: str
    kind: str
    previous: str
    note: str = ""

    @property
    def head(self) -> Head:
        """The row's seal it keeps."""
        return Head(sequence=self.sequence, hash=self.hash, at=self.at)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reached:
    """How far the file reached at one moment: its size, and the SHA-256 of its last line."""

    size_bytes: int
    line_sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class AnchorReport:
    """What a reading of the whole file found."""

    lines: int
    restores: tuple[Anchor, ...]
    counts_from_byte: int
    trouble: str | None
    notes: tuple[str, ...]


class AnchorFile:
    """The file of heads."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(
        self, kind: AnchorKind, *, sequence: int, head_hash: str, note: str = "", at: datetime | None = None
    ) -> Anchor:
        """Add a line, on the disk when this returns; raise OSError where that cannot be done."""
        held = os.open(self.path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
        with os.fdopen(held, "r+b", buffering=0) as file:
            fcntl.flock(file, fcntl.LOCK_EX)  # a restore may write beside a service that stops
            tail = _tail(file)
            anchor = Anchor(
                at=utc_text(at or datetime.now(UTC)),
                sequence=sequence,
                hash=head_hash,
                kind=kind,
                previous=_sha256(_last_line(tail)),
                note=note[:NOTE_CHARACTERS],
            )
            # A line that a power cut tore is ended, never taken back: the file only grows.
            line = (b"" if tail.endswith(b"\n") or not tail else b"\n") + _line(anchor)
            if file.write(line) != len(line):
                msg = f"{self.path.name}: the line could not be written whole"
                raise OSError(msg)
            os.fsync(file.fileno())
        return anchor

    def last(self) -> Anchor | None:
        """Return the newest whole line, None where there is none yet."""
        try:
            with self.path.open("rb") as file:
                lines = _tail(file).split(b"\n")
        except FileNotFoundError:
            return None
        return next((found for found in map(_parsed, reversed(lines)) if found is not None), None)

    def reached(self) -> Reached | None:
        """Say how far the file reaches, None where there is no file."""
        try:
            with self.path.open("rb") as file:
                tail = _tail(file)
                return Reached(size_bytes=file.seek(0, os.SEEK_END), line_sha256=_sha256(_last_line(tail)))
        except FileNotFoundError:
            return None

    def still_reaches(self, reached: Reached) -> bool:
        """Whether what was there at an earlier moment is there still."""
        try:
            with self.path.open("rb") as file:
                if file.seek(0, os.SEEK_END) < reached.size_bytes:
                    return False
                file.seek(max(0, reached.size_bytes - TAIL_BYTES))
                tail = file.read(min(TAIL_BYTES, reached.size_bytes))
        except FileNotFoundError:
            return False
        return _sha256(_last_line(tail)) == reached.line_sha256

    def report(self) -> AnchorReport:
        """Read the whole file: whether each line follows from the one before, and where backups were restored."""
        restores: list[Anchor] = []
        notes: list[str] = []
        trouble, counts_from, number, before, last_sequence = None, 0, 0, GENESIS_HASH, 0
        for number, (start, raw) in enumerate(self._lines(), 1):
            anchor = _parsed(raw)
            if anchor is None:
                notes.append(f"line {number} of the anchor file cannot be read: it was torn while it was written")
            else:
                if anchor.kind == "restore":
                    restores.append(anchor)
                    counts_from = start
                elif trouble is None and anchor.sequence < last_sequence:
                    trouble = (
                        f"line {number} of the anchor file anchors row {anchor.sequence} after row {last_sequence}, "
                        "and no restore of a backup stands between them: rows were cut off before it was written"
                    )
                if trouble is None and anchor.previous != before:
                    trouble = f"line {number} of the anchor file does not follow from the line before it"
                last_sequence = anchor.sequence
            before = _sha256(raw)
        return AnchorReport(
            lines=number,
            restores=tuple(restores),
            counts_from_byte=counts_from,
            trouble=trouble,
            notes=(*(_restore_note(one) for one in restores), *notes),
        )

    def heads(self, from_byte: int = 0) -> Iterator[Head]:
        """Read the heads that count, in the order of the file."""
        for start, raw in self._lines():
            anchor = _parsed(raw) if start >= from_byte else None
            if anchor is not None:
                yield anchor.head

    def _lines(self) -> Iterator[tuple[int, bytes]]:
        """Read each line with where it begins; what is added meanwhile is left alone."""
        try:
            size_bytes = self.path.stat().st_size
            with self.path.open("rb") as file:
                start = 0
                while start < size_bytes and (line := file.readline(MAX_LINE_BYTES)):
                    yield start, line.rstrip(b"\n")
                    start += len(line)
        except FileNotFoundError:
            return


def note_restore(path: Path, *, sequence: int, head_hash: str, source: str, at: datetime | None = None) -> Anchor:
    """Say that a backup was restored whose newest audit row is ``sequence``; raise OSError if that cannot be said."""
    return AnchorFile(path).append("restore", sequence=sequence, head_hash=head_hash, note=source, at=at)


def _restore_note(anchor: Anchor) -> str:
    source = f" ({anchor.note})" if anchor.note else ""
    return f"a backup that ends with row {anchor.sequence} was restored at {anchor.at}{source}"


def _tail(file: BinaryIO) -> bytes:
    end = file.seek(0, os.SEEK_END)
    file.seek(max(0, end - TAIL_BYTES))
    return file.read(TAIL_BYTES)


def _last_line(tail: bytes) -> bytes:
    return tail.rstrip(b"\n").rpartition(b"\n")[2]


def _sha256(line: bytes) -> str:
    return hashlib.sha256(line).hexdigest() if line else GENESIS_HASH


def _line(anchor: Anchor) -> bytes:
    said = {name: getattr(anchor, name) for name in ("at", "sequence", "hash", "kind", "previous")}
    return f"{canonical_json({**said, **({'note': anchor.note} if anchor.note else {})})}\n".encode()


def _parsed(raw: bytes) -> Anchor | None:
    try:
        said = json.loads(raw)
        anchor = Anchor(**said)
    except (ValueError, TypeError):
        return None
    is_whole = isinstance(anchor.sequence, int) and all(
        isinstance(text, str) for text in (anchor.at, anchor.hash, anchor.kind, anchor.previous, anchor.note)
    )
    return anchor if is_whole else None
