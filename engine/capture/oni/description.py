"""Content of an ``.oni`` file, as returned by :func:`engine.capture.oni.reader.describe`."""

from dataclasses import asdict, dataclass, field

from engine.capture.oni.streams import CodedFrame, StreamDescription
from engine.core.errors import RecordingError

_MAX_LISTED_GAPS = 100


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
    gaps: tuple[Gap, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingDescription:
    """Content of a recording, as far as it is readable; ``damage`` is what ends it, None if it is intact."""

    name: str
    file_bytes: int
    version: str
    duration_s: float
    depth: StreamSummary
    color: StreamSummary | None
    is_checked: bool
    damage: str | None

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


@dataclass(slots=True)
class Tally:
    """Counts one stream's frames."""

    frames: int = 0
    missed_frames: int = 0
    coded_bytes: int = 0
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
            gaps=tuple(self.gaps),
        )
