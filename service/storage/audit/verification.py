"""Verification of the chain: finds the first row that does not follow from the one before, and the likely cause.

Rows are read as plain tuples in pieces: a million rows take seconds at constant memory, and a caller in a running
service can release the database and the interpreter between two pieces.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple, Protocol

from sqlalchemy import Select, func, select
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from service.storage.audit.chain import COLUMNS, GENESIS_HASH, Link, seal
from service.storage.database.tables import AuditRow

PIECE_ROWS = 2000
NEAR_ROWS = 1000
"""Distance, in rows, within which the original position of a moved row is searched."""

NO_TEXT = "decode to UTF-8"
"""SQLite driver's error for a text column that is not UTF-8, as after tampering with the file."""
UNREADABLE = ("", "", "", "", None, "", "", "")


class Breakage(StrEnum):
    """The kinds of a break in the chain."""

    CHANGED = "changed"
    MISSING = "missing"
    INSERTED = "inserted"
    REORDERED = "reordered"
    RESEALED = "resealed"
    CUT_OFF = "cut_off"
    REPLACED = "replaced"
    ANCHORS = "anchors"


class Head(NamedTuple):
    """Sequence and hash of a row, as anchored outside the database."""

    sequence: int
    hash: str
    at: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Verification:
    """Result of a verification; ``rows`` is the number of valid rows, ``notes`` are further findings for a person."""

    rows: int
    head_hash: str
    first_broken_sequence: int | None = None
    breakage: Breakage | None = None
    detail: str = "every row follows from the one before"
    notes: tuple[str, ...] = ()

    @property
    def is_intact(self) -> bool:
        """Whether no break was found."""
        return self.breakage is None


class Reader(Protocol):
    """Reads a piece of the audit log."""

    def __call__(self, after: int | None, limit: int) -> list[Link]:
        """Return up to ``limit`` rows after a sequence, in order; None reads from the first row."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Break:
    """The first row that does not follow, with the likely cause."""

    sequence: int
    breakage: Breakage
    detail: str


class Walk:
    """Verifies rows in order, against the heads; stops at the first break."""

    def __init__(self, heads: Iterable[Head] = (), *, after: Link | None = None) -> None:
        self.previous_hash = GENESIS_HASH if after is None else after.hash
        self.last_sequence = 0 if after is None else after.sequence
        self.rows = 0
        self.broken: Break | None = None
        self._heads = iter(heads)
        self._head = next(self._heads, None)
        self._pass_heads_before(self.last_sequence + 1)

    def take(self, links: list[Link]) -> bool:
        """Verify the next rows; return False at the first break."""
        for place, link in enumerate(links):
            if not self._follows(link):
                following = links[place + 1] if place + 1 < len(links) else None
                self.broken = self._break_at(link, following)
                return False
            self.previous_hash, self.last_sequence = link.hash, link.sequence
            self.rows += 1
            if self._head is not None and self._head.sequence <= link.sequence and not self._is_as_kept(link):
                return False
        return True

    def end(self) -> Verification:
        """Return the result after the last row; a head beyond it means that rows were cut off."""
        if self.broken is None and self._head is not None:
            self.broken = self._cut_off(self._head)
        return self.result()

    def result(self) -> Verification:
        """Return the result for the rows verified so far."""
        if self.broken is None:
            return Verification(rows=self.rows, head_hash=self.previous_hash)
        return Verification(
            rows=self.rows,
            head_hash=self.previous_hash,
            first_broken_sequence=self.broken.sequence,
            breakage=self.broken.breakage,
            detail=self.broken.detail,
        )

    def _follows(self, link: Link) -> bool:
        is_next = link.sequence == self.last_sequence + 1 and link.previous_hash == self.previous_hash
        return is_next and is_sealed(link)

    def _pass_heads_before(self, sequence: int) -> None:
        while self._head is not None and self._head.sequence < sequence:
            self._head = next(self._heads, None)

    def _is_as_kept(self, link: Link) -> bool:
        """Whether a row matches all heads anchored for it."""
        while self._head is not None and self._head.sequence <= link.sequence:
            if self._head.hash != link.hash:
                detail = (
                    f"row {link.sequence} is not the row that was anchored at {self._head.at}: it, or a row before it, "
                    "was written anew and sealed again"
                )
                self.broken = Break(sequence=link.sequence, breakage=Breakage.REPLACED, detail=detail)
                return False
            self._head = next(self._heads, None)
        return True

    def _cut_off(self, head: Head) -> Break:
        first = self.last_sequence + 1
        last = max([head.sequence, *(later.sequence for later in self._heads)])
        which = f"row {first} is" if last == first else f"rows {first} to {last} are"
        detail = f"{which} missing at the end: row {head.sequence} was anchored at {head.at}"
        return Break(sequence=first, breakage=Breakage.CUT_OFF, detail=detail)

    def _break_at(self, link: Link, following: Link | None) -> Break:
        expected = self.last_sequence + 1
        if link.sequence != expected:
            breakage = Breakage.MISSING if link.sequence > expected else Breakage.INSERTED
            words = "is missing before" if link.sequence > expected else "is the first one, and yet there is"
            return Break(
                sequence=link.sequence, breakage=breakage, detail=f"row {expected} {words} row {link.sequence}"
            )
        breakage, detail = _explained(link, following)
        return Break(sequence=link.sequence, breakage=breakage, detail=detail)


def is_sealed(link: Link) -> bool:
    """Whether a row's hash matches its content; False if the content is not JSON."""
    try:
        return seal(link) == link.hash
    except (TypeError, ValueError):
        return False


def _explained(link: Link, following: Link | None) -> tuple[Breakage, str]:
    """Derive the cause of a break from the position at which the row's hash would match."""
    here, was = link.sequence, _sealed_as(link)
    if was is None:
        return Breakage.CHANGED, f"row {here} was changed after it was written"
    if was == here:
        text = (
            f"row {here} does not follow from the row before it, which was changed or inserted with a recomputed hash"
        )
        return Breakage.RESEALED, text
    if was == here - 1:
        return Breakage.INSERTED, f"row {here} was written as row {was}: a row was put in before it"
    if was == here + 1 and (following is None or _sealed_as(following) != here):
        return Breakage.MISSING, f"row {here} was written as row {was}: a row before it was taken out"
    return Breakage.REORDERED, f"row {here} was written as row {was}: rows changed places"


def _sealed_as(link: Link) -> int | None:
    """Return the position at which a row's hash matches, nearest first; None if there is none."""
    try:
        for off in range(NEAR_ROWS + 1):
            for place in {link.sequence + off, link.sequence - off}:
                if seal(link, sequence=place) == link.hash:
                    return place
    except (TypeError, ValueError):
        return None
    return None


def read_links(db: Session, after: int | None, limit: int) -> list[Link]:
    """Return up to ``limit`` rows after a sequence, in order; None reads from the first row.

    Fewer rows are returned before a row that is not UTF-8; of such a row only the sequence is read.
    """
    try:
        return [Link._make(row) for row in db.execute(_after(select(*COLUMNS), after).limit(limit))]
    except OperationalError as error:
        if NO_TEXT not in str(error.orig):
            raise
    if limit > 1:
        return read_links(db, after, limit // 2)
    return [Link(sequence, *UNREADABLE) for sequence in db.scalars(_after(select(AuditRow.sequence), after).limit(1))]


def _after(query: "Select[tuple[Any, ...]]", after: int | None) -> "Select[tuple[Any, ...]]":
    query = query.order_by(AuditRow.sequence)
    return query if after is None else query.where(AuditRow.sequence > after)


def head_sequence(db: Session) -> int:
    """Return the newest row's sequence; 0 if the log is empty."""
    return db.scalar(select(func.max(AuditRow.sequence))) or 0


def verify(db: Session, heads: Iterable[Head] = ()) -> Verification:
    """Verify the whole chain in one database session."""
    return verify_pieces(lambda after, limit: read_links(db, after, limit), heads)


def verify_pieces(
    read: Reader, heads: Iterable[Head] = (), *, on_piece: Callable[[int], None] = lambda _rows: None
) -> Verification:
    """Verify the whole chain in pieces; ``on_piece`` receives the number of verified rows."""
    walk = Walk(heads)
    for links in pieces(read):
        if not walk.take(links):
            break
        on_piece(walk.rows)
    return walk.end()


def pieces(read: Reader, *, after: int | None = None, up_to: int | None = None) -> Iterator[list[Link]]:
    """Yield all rows in pieces, up to sequence ``up_to`` if given."""
    while links := read(after, PIECE_ROWS):
        if up_to is not None and links[-1].sequence > up_to:
            yield [link for link in links if link.sequence <= up_to]
            return
        yield links
        after = links[-1].sequence
