"""Read ``.oni`` recordings: every frame exactly once, in the file's order, with the number missing before it.

Our own parser, because the runtime's player loses frames when it is read faster or slower than real time. A damaged
file gives the frames before the damage, then one clear error.

Content of an ``.oni`` file, as returned by :func:`engine.capture.oni.reader.describe`.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Self

from engine.capture.oni import records
from engine.capture.oni.records import FileHeader, Record, RecordType, read_camera, read_file_header, walk_records
from engine.capture.oni.streams import CodedFrame, NodeTable, StreamDescription
from engine.core.errors import RecordingError
from engine.core.files import open_plain

_MAX_LISTED_GAPS = 100
START_FRAMES = 40
"""Depth frames at the beginning of a recording whose times are looked at in a list."""
LEAST_FPS, MOST_FPS = 1.0, 240.0
"""Rates that a depth camera may have [1/s]: times in milliseconds give 30,000."""
_US_PER_S = 1_000_000
_MAX_TIMESTAMP_US = 2**62


@dataclass(frozen=True, slots=True, kw_only=True)
class Gap:
    """A place where frames are missing: after which frame, when [us], how many."""

    after_frame: int
    timestamp_us: int
    missed_frames: int


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamSummary:
    """Content of one stream.

    Attributes
    ----------
    claimed_frames
        Number that the file announces; None where it does not.
    nominal_fps, measured_fps
        Rate as announced and as the timestamps have it [1/s]; None for fewer than two frames.
    gaps
        The first hundred places where frames are missing.
    """

    codec: str
    width: int
    height: int
    frames: int
    claimed_frames: int | None
    missed_frames: int
    nominal_fps: int
    measured_fps: float | None
    first_timestamp_us: int | None
    last_timestamp_us: int | None
    coded_bytes: int
    has_shift_table: bool
    is_mirrored: bool
    times_back: int
    gaps: tuple[Gap, ...]

    @property
    def impossible_times(self) -> str | None:
        """Why the times of the stream cannot be those of a camera; None where they can."""
        if self.times_back:
            return f"{self.times_back} times go back or stand still"
        if self.measured_fps is None or not LEAST_FPS <= self.measured_fps <= MOST_FPS:
            rate = "none" if self.measured_fps is None else f"{self.measured_fps:.4g}"
            return None if self.frames < 2 else f"{rate} frames/s by its times, {LEAST_FPS:g} to {MOST_FPS:g} can be"
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingDescription:
    """Content of a recording, as far as it is readable.

    ``damage`` is what ends it, None if it is intact; ``impossible_times`` is why its times are no camera's, None if
    they may be; ``serial`` is its camera's serial number, empty where the file does not have it.
    """

    name: str
    file_bytes: int
    version: str
    duration_s: float
    depth: StreamSummary
    color: StreamSummary | None
    is_checked: bool
    damage: str | None
    impossible_times: str | None
    serial: str

    @property
    def mirrored(self) -> str | None:
        """Name the streams whose pictures are stored mirrored; None where none is."""
        return mirrored_streams(self.depth, self.color)

    @property
    def depth_frames(self) -> int:
        """Depth frames that can be read."""
        return self.depth.frames

    def raise_damage(self) -> None:
        """Raise RecordingError if the recording is not whole."""
        if self.damage is not None:
            raise RecordingError(self.damage)

    def document(self) -> dict[str, object]:
        """Return plain values, for JSON."""
        return asdict(self)


def mirrored_streams(
    depth: StreamDescription | StreamSummary, color: StreamDescription | StreamSummary | None
) -> str | None:
    """Name the streams whose pictures are stored mirrored; None where none is."""
    streams = {"depth": depth, "colour": color}
    return " and ".join(name for name, one in streams.items() if one is not None and one.is_mirrored) or None


@dataclass(slots=True)
class Tally:
    """Counts one stream's frames."""

    frames: int = 0
    missed_frames: int = 0
    coded_bytes: int = 0
    times_back: int = 0
    first_us: int | None = None
    last_us: int | None = None
    last_id: int = 0
    gaps: list[Gap] = field(default_factory=list)

    def add(self, frame: CodedFrame) -> None:
        """Count one more frame, in order."""
        if frame.missed_frames:
            self.missed_frames += frame.missed_frames
            if len(self.gaps) < _MAX_LISTED_GAPS:
                self.gaps.append(
                    Gap(
                        after_frame=self.last_id,
                        timestamp_us=self.last_us or 0,
                        missed_frames=frame.missed_frames,
                    )
                )
        self.times_back += self.last_us is not None and frame.timestamp_us <= self.last_us
        self.frames += 1
        self.coded_bytes += frame.coded_bytes
        self.first_us = frame.timestamp_us if self.first_us is None else self.first_us
        self.last_us, self.last_id = frame.timestamp_us, frame.frame_id

    def summary(self, stream: StreamDescription) -> StreamSummary:
        """Return the summary of the counted frames."""
        span_us = self.last_us - self.first_us if self.last_us is not None and self.first_us is not None else 0
        intervals = self.frames - 1 + self.missed_frames
        return StreamSummary(
            codec=stream.codec,
            width=stream.size_px[0],
            height=stream.size_px[1],
            frames=self.frames,
            claimed_frames=stream.claimed_frames,
            missed_frames=self.missed_frames,
            nominal_fps=stream.fps,
            measured_fps=intervals * 1e6 / span_us if intervals > 0 and span_us > 0 else None,
            first_timestamp_us=self.first_us,
            last_timestamp_us=self.last_us,
            coded_bytes=self.coded_bytes,
            has_shift_table=stream.has_shift_table,
            is_mirrored=stream.is_mirrored,
            times_back=self.times_back,
            gaps=tuple(self.gaps),
        )


class OniReader:
    """An open recording; a context manager, for one thread.

    Raises
    ------
    RecordingError
        On opening: no recording, or one without a readable depth stream. One line, beginning with the file's name.
    """

    def __init__(self, path: Path) -> None:
        self._path = Path(path)
        try:
            self._file = open_plain(self._path)
        except (OSError, ValueError) as error:  # a name with a NUL is a ValueError
            msg = f"{self.name}: cannot be opened ({getattr(error, 'strerror', None) or error})"
            raise RecordingError(msg) from error
        try:
            self.header = read_file_header(self._file)
            self.serial = read_camera(self._file)
            self._nodes, self._depth = self._read_nodes()
        except (RecordingError, OSError) as error:
            self.close()
            raise self._named(error) from error

    @property
    def name(self) -> str:
        """The file's name, printable on one line."""
        return "".join(letter if letter.isprintable() else "?" for letter in self._path.name) or "?"

    @property
    def file_bytes(self) -> int:
        """The file's size."""
        return os.fstat(self._file.fileno()).st_size

    @property
    def depth(self) -> StreamDescription:
        """The depth stream."""
        return self._depth

    @property
    def color(self) -> StreamDescription | None:
        """The colour stream."""
        return self._nodes.color

    @property
    def mirrored(self) -> str | None:
        """Name the streams whose pictures are stored mirrored; None where none is."""
        return mirrored_streams(self.depth, self.color)

    def impossible_start(self) -> str | None:
        """Return why the times of the first frames cannot be a camera's; None where they can, or cannot be read."""
        tally = Tally()
        with suppress(RecordingError):
            for frame in self.frames(with_payload=False):
                if frame.is_depth:
                    tally.add(frame)
                if tally.frames >= START_FRAMES:
                    break
        found = tally.summary(self.depth).impossible_times
        return None if found is None else f"its times are impossible: {found}"

    def frames(self, *, with_payload: bool = True) -> Iterator[CodedFrame]:
        """Yield the frames of the depth and the colour stream in the file's order, from the first.

        Only one such iteration at a time.

        Raises
        ------
        RecordingError
            The file is cut or damaged from here on; every frame before was yielded.
        """
        counters: dict[int, _Counter] = {}
        nodes = NodeTable(self.header)
        try:
            for record in walk_records(self._file, self.header):
                if record.type is not RecordType.NEW_DATA:
                    nodes.apply(record)
                    continue
                stream = nodes.stream_of(record)
                if stream is not nodes.depth and stream is not nodes.color:
                    continue
                stream.check_readable()
                counter = counters.setdefault(record.node, _Counter(stream))
                yield counter.frame(record, stream, self.header, self._payload(record) if with_payload else b"")
        except (RecordingError, OSError) as error:
            raise self._named(error) from error

    def repeated_frames(self) -> Iterator[CodedFrame]:
        """Yield the frames again and again; numbers and times go on, with one period of depth at the seam.

        A recording without depth frames ends; damage is raised as by `frames`, and nothing is repeated then.
        """
        numbers, shift_us = {True: 0, False: 0}, 0
        while True:
            last, depth_us = dict(numbers), []
            for frame in self.frames():
                last[frame.is_depth] = frame.frame_id + numbers[frame.is_depth]
                if frame.is_depth:
                    depth_us.append(frame.timestamp_us)
                yield replace(frame, frame_id=last[frame.is_depth], timestamp_us=frame.timestamp_us + shift_us)
            if not depth_us:
                return
            shift_us += depth_us[-1] - depth_us[0] + round(_US_PER_S / self.depth.fps)
            numbers = last

    def close(self) -> None:
        """Close the file; safe to call twice."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _read_nodes(self) -> tuple[NodeTable, StreamDescription]:
        """Read up to the first frame: the descriptions of the streams precede it."""
        nodes = NodeTable(self.header)
        damage = None
        try:
            for record in walk_records(self._file, self.header):
                if record.type is RecordType.NEW_DATA:
                    break
                nodes.apply(record)
        except RecordingError as error:
            damage = error  # raised again, in its place, by `frames`
        if nodes.depth is None:
            raise damage or RecordingError("the recording has no depth stream")
        if damage is None:
            for stream in filter(None, (nodes.depth, nodes.color)):
                stream.check_readable()
        return nodes, nodes.depth

    def _payload(self, record: Record) -> bytes:
        self._file.seek(record.payload_at)
        payload = self._file.read(record.payload_bytes)
        if len(payload) != record.payload_bytes:
            msg = f"cut at byte {record.payload_at + len(payload)}, within a frame"
            raise RecordingError(msg)
        return payload

    def _named(self, error: Exception) -> RecordingError:
        text = error.strerror if isinstance(error, OSError) else str(error)
        return RecordingError(f"{self.name}: {text}")


class _Counter:
    """Checks the numbers and times of one stream, and counts missing frames."""

    def __init__(self, stream: StreamDescription) -> None:
        self._size_px = stream.size_px
        self._period_us = _US_PER_S / stream.fps
        self._last: tuple[int, int] | None = None

    def frame(self, record: Record, stream: StreamDescription, header: FileHeader, payload: bytes) -> CodedFrame:
        if len(record.fields) < records.FRAME_FIELDS.size:
            msg = f"damaged at byte {record.at}: a frame without time and number"
            raise RecordingError(msg)
        timestamp_us, frame_id = records.FRAME_FIELDS.unpack_from(record.fields)
        self._check(record.at, stream, timestamp_us, frame_id, header.last_timestamp_us)
        missed_frames = self._count_missed(timestamp_us, frame_id)
        self._last = timestamp_us, frame_id
        return CodedFrame(
            stream=stream,
            frame_id=frame_id,
            timestamp_us=timestamp_us,
            missed_frames=missed_frames,
            coded_bytes=record.payload_bytes,
            payload=payload,
        )

    def _check(
        self, at: int, stream: StreamDescription, timestamp_us: int, frame_id: int, last_timestamp_us: int | None
    ) -> None:
        if stream.size_px != self._size_px:
            msg = f"damaged at byte {at}: the picture size changes to {stream.size_px[0]}x{stream.size_px[1]}"
        elif timestamp_us > (_MAX_TIMESTAMP_US if last_timestamp_us is None else last_timestamp_us):
            msg = f"damaged at byte {at}: a frame at {timestamp_us} us, after the end of the recording"
        elif stream.claimed_frames is not None and frame_id > stream.claimed_frames:
            msg = f"damaged at byte {at}: frame {frame_id} of {stream.claimed_frames}"
        elif self._last is not None and frame_id <= self._last[1]:
            msg = f"damaged at byte {at}: frame {frame_id} comes after frame {self._last[1]}"
        else:
            return
        raise RecordingError(msg)

    def _count_missed(self, timestamp_us: int, frame_id: int) -> int:
        if self._last is None:
            return 0
        return missed_between(self._last, (timestamp_us, frame_id), self._period_us)


def missed_between(before: tuple[int, int], after: tuple[int, int], period_us: float) -> int:
    """Count the frames missing between two frames, given as (time [us], number): by number or by time, the larger."""
    by_number = after[1] - before[1] - 1
    by_time = round((after[0] - before[0]) / period_us) - 1
    return max(by_number, by_time, 0)


def describe(
    path: Path, *, is_checked: bool = False, on_progress: Callable[[int, int], None] = lambda _done, _total: None
) -> RecordingDescription:
    """Describe the content of a recording; ``is_checked`` decodes every picture too.

    ``on_progress`` is called with the bytes walked and the bytes there are.

    Raises
    ------
    RecordingError
        Not a recording. One that is cut or damaged later is described up to there.
    """
    depth, color = Tally(), Tally()
    damage = None
    with OniReader(path) as reader:
        file_bytes = reader.file_bytes
        try:
            for frame in reader.frames(with_payload=is_checked):
                if is_checked:
                    _check_picture(reader, frame)
                (depth if frame.is_depth else color).add(frame)
                on_progress(depth.coded_bytes + color.coded_bytes, file_bytes)
        except RecordingError as error:
            damage = str(error)
        if damage is None and depth.frames == 0:
            damage = f"{reader.name}: the recording holds no depth frame"
        times_us = [t for tally in (depth, color) for t in (tally.first_us, tally.last_us) if t is not None]
        summaries = {
            "depth": depth.summary(reader.depth),
            "colour": None if reader.color is None else color.summary(reader.color),
        }
        impossible = [
            f"{kind}: {one.impossible_times}" for kind, one in summaries.items() if one and one.impossible_times
        ]
        return RecordingDescription(
            name=reader.name,
            file_bytes=file_bytes,
            version=".".join(map(str, reader.header.version)),
            duration_s=(max(times_us) - min(times_us)) / 1e6 if times_us else 0.0,
            depth=depth.summary(reader.depth),
            color=summaries["colour"],
            is_checked=is_checked,
            damage=damage,
            impossible_times="; ".join(impossible) or None,
            serial=reader.serial,
        )


def _check_picture(reader: OniReader, frame: CodedFrame) -> None:
    kind = "depth" if frame.is_depth else "colour"
    try:
        if frame.is_depth:
            frame.decode_depth()
        else:
            frame.decode_color()
    except RecordingError as error:
        msg = f"{reader.name}: {kind} frame {frame.frame_id}: {error}"
        raise RecordingError(msg) from error
