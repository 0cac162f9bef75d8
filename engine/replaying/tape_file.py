"""A tape on disk: lines of JSON in one stream of zlib, ended at every writing so that a torn file reads up to the tear.

The first line says what ran: settings, calibration, software, machine, and where the frames lie. Then comes a line a
turn, ``h`` being pairs of where an answer came from and what it was, readings of the clock as steps from the one
before; ``r`` what came of it, ``e`` what other threads told. The last line is the end, or why there is none.
"""

import json
import operator
import os
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from engine.errors import RecordingError
from engine.replaying.outcomes import Row, row_of
from engine.replaying.spelling import Spelling
from engine.replaying.taping import Turn
from engine.witness import Seam

SCHEMA = "tidegate.tape/1"
SUFFIX = ".tape"
CHUNK_BYTES = 1 << 16
LEVEL = 3
LONGEST_LINE = 1 << 26


@dataclass(frozen=True, slots=True, kw_only=True)
class HeardTurn:
    """A turn as read back; answers are still in a tape's words, but for the clock's."""

    heard: list[tuple[Seam, Any]]
    rows: list[Row]
    elsewhere: list[Row]


@dataclass(slots=True, kw_only=True)
class Tape:
    """A tape as read: its head, its turns as they are asked for, and how it ended once they are over.

    Attributes
    ----------
    facts
        What was written beside the turns, such as the hash of the recording.
    is_whole
        Whether the end was read.
    torn
        Why the tape ends early, where its writer knew.
    """

    head: dict[str, Any]
    lines: Iterator[dict[str, Any]]
    facts: dict[str, Any] = field(default_factory=dict)
    is_whole: bool = False
    torn: str | None = None

    def turns(self) -> Iterator[HeardTurn]:
        """Yield every turn, once."""
        clock_ns = 0
        for line in self.lines:
            if "h" not in line:
                self._take(line)
                continue
            try:
                heard, clock_ns = _heard(line["h"], clock_ns)
                rows, elsewhere = (_rows(line.get(name, [])) for name in ("r", "e"))
            except (TypeError, ValueError) as error:
                msg = f"the tape is damaged: {type(error).__name__} in a turn"
                raise RecordingError(msg) from error
            yield HeardTurn(heard=heard, rows=rows, elsewhere=elsewhere)

    def _take(self, line: dict[str, Any]) -> None:
        torn, facts = line.get("torn", self.torn), line.get("facts", {})
        if not isinstance(torn, str | None) or not isinstance(facts, dict):
            msg = "the tape is damaged: it ends with what is no end"
            raise RecordingError(msg)
        self.is_whole = self.is_whole or "end" in line
        self.torn = torn
        self.facts |= facts


def _heard(words: list[Any], clock_ns: int) -> tuple[list[tuple[Seam, Any]], int]:
    """Return a turn's answers, each with where it came from, and the clock's last reading."""
    heard = []
    for word, answer in zip(words[::2], words[1::2], strict=True):
        seam = Seam(word)
        if seam is Seam.CLOCK:
            clock_ns += operator.index(answer)
        heard.append((seam, clock_ns if seam is Seam.CLOCK else answer))
    return heard, clock_ns


def _rows(words: object) -> list[Row]:
    if not isinstance(words, list) or not all(isinstance(row, dict) for row in words):
        msg = "no rows"
        raise TypeError(msg)
    return words


class TapeFile:
    """A tape being written; for one thread."""

    def __init__(self, path: Path, head: dict[str, Any], spelling: Spelling) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("xb")
        self._packer = zlib.compressobj(LEVEL)
        self._spelling = spelling
        self._clock_ns = 0
        self._turns = 0
        self._lines: list[str] = []
        self._add({"tape": SCHEMA, **head})
        self.write()

    def add(self, turn: Turn) -> None:
        """Take a turn."""
        words: list[Any] = []
        for seam, answer in turn.heard:
            words.append(int(seam))
            if seam is Seam.CLOCK:
                words.append(answer - self._clock_ns)
                self._clock_ns = answer
            else:
                words.append(self._spelling.spell(answer))
        line: dict[str, Any] = {"h": words}
        if turn.told:
            line["r"] = [row_of(outcome) for outcome in turn.told]
        if turn.elsewhere:
            line["e"] = [row_of(outcome) for outcome in turn.elsewhere]
        self._turns += 1
        self._add(line)

    def note(self, **facts: object) -> None:
        """Take something that is known only now."""
        self._add({"facts": facts})

    def end(self, torn: str | None) -> None:
        """Write the last line, and close."""
        self._add({"end": self._turns} if torn is None else {"torn": torn})
        self._file.write(self._packed() + self._packer.flush(zlib.Z_FINISH))
        self.sync()
        self._file.close()

    def write(self) -> None:
        """Give what was taken to the system: a killed process loses none of it."""
        if self._lines:
            self._file.write(self._packed() + self._packer.flush(zlib.Z_SYNC_FLUSH))
            self._file.flush()

    def sync(self) -> None:
        """Give what was written to the disk."""
        self._file.flush()
        os.fsync(self._file.fileno())

    def _add(self, line: dict[str, Any]) -> None:
        self._lines.append(json.dumps(line, separators=(",", ":")) + "\n")

    def _packed(self) -> bytes:
        lines, self._lines = self._lines, []
        return self._packer.compress("".join(lines).encode())


def read_tape(path: Path) -> Tape:
    """Open a tape; its turns are read as they are asked for.

    Raises
    ------
    RecordingError
        No tape, or one of another kind.
    """
    if not path.is_file():
        msg = f"{path.name}: there is no such tape"
        raise RecordingError(msg)
    lines = _lines(path)
    head = next(lines, {})
    if head.get("tape") != SCHEMA:
        msg = f"{path.name}: no tape of a session ({SCHEMA})"
        raise RecordingError(msg)
    return Tape(head=head, lines=lines)


def _lines(path: Path) -> Iterator[dict[str, Any]]:
    """Yield whole lines; what is torn off at the end is left out."""
    rest = b""
    for text in _unpacked(path):
        *lines, rest = (rest + text).split(b"\n")
        if len(rest) > LONGEST_LINE:
            msg = f"{path.name}: a line without an end"
            raise RecordingError(msg)
        for line in lines:
            try:
                found = json.loads(line)
            except (ValueError, RecursionError) as error:
                msg = f"{path.name}: damaged ({error})"
                raise RecordingError(msg) from error
            if not isinstance(found, dict):
                msg = f"{path.name}: damaged (a line that is no object)"
                raise RecordingError(msg)
            yield found


def _unpacked(path: Path) -> Iterator[bytes]:
    unpacker = zlib.decompressobj()
    with path.open("rb") as file:
        while packed := file.read(CHUNK_BYTES):
            try:
                yield unpacker.decompress(packed)
            except zlib.error as error:
                msg = f"{path.name}: damaged ({error})"
                raise RecordingError(msg) from error
