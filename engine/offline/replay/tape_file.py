"""A tape on disk: lines of JSON in one stream of zlib, ended at every writing so that a torn file reads up to the tear.

The first line is the header: settings, calibration, software, machine, and where the frames are. Then follows one line
per turn: ``h`` holds pairs of a reading's kind and its value (the clock's as a step from the reading before), ``r`` the
outputs, ``e`` the transitions of other threads. The last line is the end, or the reason why the tape has none.

The readings of one turn of a tape, given back one by one in the order in which they were made.
"""

import enum
import json
import operator
import os
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from engine.core.errors import RecordingError
from engine.core.input_tap import InputKind
from engine.offline.replay.encoding import TapeEncoding
from engine.offline.replay.outcomes import Row, row_of
from engine.offline.replay.recording_tap import Turn

SCHEMA = "tidegate.tape/2"
SUFFIX = ".tape"
CHUNK_BYTES = 1 << 16
LEVEL = 3
LONGEST_LINE = 1 << 26


class OtherReadingError(Exception):
    """Another reading is next on the tape.

    Attributes
    ----------
    name
        The kind that is next; None at the end of the turn.
    """

    def __init__(self, name: str | None) -> None:
        super().__init__(name)
        self.name = name


class RecordedReadings:
    """Readings as values; ``decode`` decodes one."""

    def __init__(self, observed: Sequence[tuple[enum.IntEnum, Any]], decode: Callable[[Any], Any]) -> None:
        self._coming, self._decode = iter(observed), decode

    def take(self, kind: InputKind) -> Any:  # noqa: ANN401 - any reading
        """Return the next value, which is of this kind; raise OtherReadingError where another reading is next."""
        following, encoded = next(self._coming, (None, None))
        if following is not kind:
            raise OtherReadingError(None if following is None else following.name)
        return self._decode(encoded)

    def rest(self) -> str | None:
        """Return the name of the next reading; None at the end."""
        following, _encoded = next(self._coming, (None, None))
        return None if following is None else following.name


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedTurn:
    """A turn as read from a tape; readings are still encoded, except those of the clock."""

    observed: list[tuple[InputKind, Any]]
    rows: list[Row]
    elsewhere: list[Row]

    def readings(self, decode: Callable[[Any], Any]) -> RecordedReadings:
        """Return the turn's readings as values; ``decode`` decodes one reading."""
        return RecordedReadings(self.observed, decode)


@dataclass(slots=True, kw_only=True)
class Tape:
    """A tape as read: its header, its turns one after the other, and how it ends once they are read.

    Attributes
    ----------
    facts
        Facts noted beside the turns, such as the hash of the recording.
    is_whole
        Whether the end was read.
    torn
        Why the tape ends early, where its writer noted it.
    """

    head: dict[str, Any]
    lines: Iterator[dict[str, Any]]
    facts: dict[str, Any] = field(default_factory=dict)
    is_whole: bool = False
    torn: str | None = None

    def turns(self) -> Iterator[RecordedTurn]:
        """Yield every turn, once."""
        clock_ns = 0
        for line in self.lines:
            if "h" not in line:
                self._take(line)
                continue
            try:
                observed, clock_ns = _observed(line["h"], clock_ns)
                rows, elsewhere = (_rows(line.get(name, [])) for name in ("r", "e"))
            except (TypeError, ValueError) as error:
                msg = f"the tape is damaged: {type(error).__name__} in a turn"
                raise RecordingError(msg) from error
            yield RecordedTurn(observed=observed, rows=rows, elsewhere=elsewhere)

    def _take(self, line: dict[str, Any]) -> None:
        torn, facts = line.get("torn", self.torn), line.get("facts", {})
        if not isinstance(torn, str | None) or not isinstance(facts, dict):
            msg = "the tape is damaged: it ends with what is no end"
            raise RecordingError(msg)
        self.is_whole = self.is_whole or "end" in line
        self.torn = torn
        self.facts |= facts


def _observed(encoded: list[Any], clock_ns: int) -> tuple[list[tuple[InputKind, Any]], int]:
    """Return a turn's readings, each with its kind, and the last reading of the clock [ns]."""
    observed: list[tuple[InputKind, Any]] = []
    for number, answer in zip(encoded[::2], encoded[1::2], strict=True):
        kind = InputKind(number)
        is_clock = kind is InputKind.CLOCK
        if is_clock:
            clock_ns += operator.index(answer)
        observed.append((kind, clock_ns if is_clock else answer))
    return observed, clock_ns


def _rows(encoded: object) -> list[Row]:
    if not isinstance(encoded, list) or not all(isinstance(row, dict) for row in encoded):
        msg = "no rows"
        raise TypeError(msg)
    return encoded


class TapeFile:
    """A tape being written; for one thread."""

    def __init__(self, path: Path, head: dict[str, Any], encoding: TapeEncoding) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("xb")
        self._packer = zlib.compressobj(LEVEL)
        self._encoding = encoding
        self._clock_ns = 0
        self._turns = 0
        self._lines: list[str] = []
        self._add({"tape": SCHEMA, **head})
        self.write()

    def add(self, turn: Turn) -> None:
        """Add a turn."""
        encoded: list[Any] = []
        for kind, answer in turn.observed:
            encoded.append(int(kind))
            if kind is InputKind.CLOCK:
                encoded.append(answer - self._clock_ns)
                self._clock_ns = answer
            else:
                encoded.append(self._encoding.encode(answer))
        line: dict[str, Any] = {"h": encoded}
        if turn.emitted:
            line["r"] = [row_of(outcome) for outcome in turn.emitted]
        if turn.elsewhere:
            line["e"] = [row_of(outcome) for outcome in turn.elsewhere]
        self._turns += 1
        self._add(line)

    def note(self, **facts: object) -> None:
        """Note facts that became known after the header was written."""
        self._add({"facts": facts})

    def end(self, torn: str | None) -> None:
        """Write the last line, and close the file."""
        self._add({"end": self._turns} if torn is None else {"torn": torn})
        self._file.write(self._packed() + self._packer.flush(zlib.Z_FINISH))
        self.sync()
        self._file.close()

    def write(self) -> None:
        """Write what was added to the file: a killed process loses none of it."""
        if self._lines:
            self._file.write(self._packed() + self._packer.flush(zlib.Z_SYNC_FLUSH))
            self._file.flush()

    def sync(self) -> None:
        """Sync the file to the disk."""
        self._file.flush()
        os.fsync(self._file.fileno())

    def _add(self, line: dict[str, Any]) -> None:
        self._lines.append(json.dumps(line, separators=(",", ":")) + "\n")

    def _packed(self) -> bytes:
        lines, self._lines = self._lines, []
        return self._packer.compress("".join(lines).encode())


def read_tape(path: Path) -> Tape:
    """Open a tape; its turns are read one by one.

    Raises
    ------
    RecordingError
        The file does not exist, or is not a tape of this format.
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
    """Yield whole lines; an incomplete last line is left out."""
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
