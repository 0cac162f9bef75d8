"""Heads of the audit chain in an append-only file outside the database (the anchor file).

One JSON line per head: time, row, its hash, the kind, and the SHA-256 of the line before. If the newest rows are
deleted from the database, or the whole chain is hashed anew, it no longer matches these lines; a changed line breaks
the file's own chain; and each start of the service records in the audit how far the file reached, so that truncation of
the file is detected too. On another machine's share it is protected from a person with access to the database.

A restored backup ends earlier than the heads before it. The restore appends a line of kind ``restore``, from which on
the heads count; every verification reports such lines.
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

from service.storage.audit.chain import GENESIS_HASH, canonical_json
from service.storage.audit.verification import Head
from service.storage.database.base import utc_text

AnchorKind = Literal["start", "stop", "session", "time", "restore"]
TAIL_BYTES = 65_536
MAX_LINE_BYTES = 4096
NOTE_CHARACTERS = 200


@dataclass(frozen=True, slots=True, kw_only=True)
class Anchor:
    """One line of the anchor file; ``previous`` is the SHA-256 of the line before."""

    at: str
    sequence: int
    hash: str
    kind: str
    previous: str
    note: str = ""

    @property
    def head(self) -> Head:
        """The anchored row's sequence and hash."""
        return Head(sequence=self.sequence, hash=self.hash, at=self.at)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reached:
    """The extent of the file at one time: its size, and the SHA-256 of its last line."""

    size_bytes: int
    line_sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class AnchorReport:
    """Result of reading the whole file; ``counts_from_byte`` is the offset of the newest restore."""

    lines: int
    restores: tuple[Anchor, ...]
    counts_from_byte: int
    trouble: str | None
    notes: tuple[str, ...]


class AnchorFile:
    """The anchor file; several processes may append, under a file lock."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(
        self, kind: AnchorKind, *, sequence: int, head_hash: str, note: str = "", at: datetime | None = None
    ) -> Anchor:
        """Append a line and fsync it; raise OSError if it cannot be written completely."""
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
            # A line torn by a power cut is terminated, not removed: the file is append-only.
            line = (b"" if tail.endswith(b"\n") or not tail else b"\n") + _line(anchor)
            if file.write(line) != len(line):
                msg = f"{self.path.name}: the line could not be written whole"
                raise OSError(msg)
            os.fsync(file.fileno())
        return anchor

    def last(self) -> Anchor | None:
        """Return the newest complete line within the last 64 KiB; None if there is none."""
        try:
            with self.path.open("rb") as file:
                lines = _tail(file).split(b"\n")
        except FileNotFoundError:
            return None
        return next((found for found in map(_parsed, reversed(lines)) if found is not None), None)

    def reached(self) -> Reached | None:
        """Return the current extent; None if there is no file."""
        try:
            with self.path.open("rb") as file:
                tail = _tail(file)
                return Reached(size_bytes=file.seek(0, os.SEEK_END), line_sha256=_sha256(_last_line(tail)))
        except FileNotFoundError:
            return None

    def still_reaches(self, reached: Reached) -> bool:
        """Whether the content up to an earlier extent is still there."""
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
        """Read the whole file: check its own chain and find the restores."""
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
        """Yield the heads from a byte offset on, in file order."""
        for start, raw in self._lines():
            anchor = _parsed(raw) if start >= from_byte else None
            if anchor is not None:
                yield anchor.head

    def _lines(self) -> Iterator[tuple[int, bytes]]:
        """Yield each line with its byte offset, up to the size at the first call."""
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
    """Append a restore whose newest audit row is ``sequence``; raise OSError if that fails."""
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
    fields = {name: getattr(anchor, name) for name in ("at", "sequence", "hash", "kind", "previous")}
    return f"{canonical_json({**fields, **({'note': anchor.note} if anchor.note else {})})}\n".encode()


def _parsed(raw: bytes) -> Anchor | None:
    try:
        fields = json.loads(raw)
        anchor = Anchor(**fields)
    except (ValueError, TypeError):
        return None
    is_whole = isinstance(anchor.sequence, int) and all(
        isinstance(text, str) for text in (anchor.at, anchor.hash, anchor.kind, anchor.previous, anchor.note)
    )
    return anchor if is_whole else None
