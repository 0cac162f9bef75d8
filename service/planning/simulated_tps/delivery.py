"""Beam-on time as a planning system counts it, from the stream and from the recorder.

Pure. Times are camera timestamps [us], the clock that the stream and the recorder share. A gap counts as beam-on if the
beam was on at either end of it: a planning system must not deliver a dose twice because frames are missing.

The current beam and the delivered beam-on time of each beam, as a record-and-verify system counts them.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from service.planning.simulated_tps.report import BeamReport

US_PER_S = 1e6
BEAM_ON = "beam_on"


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """The beam state of one frame."""

    frame_index: int
    timestamp_us: int
    is_on: bool


@dataclass(slots=True)
class BeamClock:
    """Sums beam-on time frame by frame; repeated and late frames are ignored.

    Attributes
    ----------
    on_s
        Beam-on time so far [s].
    unseen_s
        Total length of the gaps [s]; the beam may have been on in them.
    frames
        Received frames: index to whether the beam line was on.
    """

    on_s: float = 0.0
    unseen_s: float = 0.0
    last: Seen | None = None
    frames: dict[int, bool] | None = None

    def note(self, seen: Seen) -> float:
        """Count a frame; return the beam-on time that it added [s]."""
        if self.frames is None:
            self.frames = {}
        last = self.last
        if last is not None and seen.frame_index <= last.frame_index:
            return 0.0
        self.frames[seen.frame_index] = seen.is_on
        self.last = seen
        if last is None:
            return 0.0
        is_gap = seen.frame_index - last.frame_index > 1
        passed_s = max(0.0, (seen.timestamp_us - last.timestamp_us) / US_PER_S)
        self.unseen_s += passed_s if is_gap else 0.0
        if not (last.is_on or (is_gap and seen.is_on)):
            return 0.0
        self.on_s += passed_s
        return passed_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorded:
    """The recorder's frames of a session; ``on_frames`` are those with beam, ``rises`` how often the beam went on."""

    frames: frozenset[int]
    on_frames: frozenset[int]
    on_s: float
    rises: int


def recorded(rows: Iterable[Mapping[str, str]]) -> Recorded:
    """Count frames, beam-on time and beam rises in the exported rows of a session."""
    clock, rises, was_on = BeamClock(), 0, False
    for row in rows:
        is_on = row["gate"] == BEAM_ON
        clock.note(Seen(frame_index=int(row["frame_index"]), timestamp_us=int(row["timestamp_us"]), is_on=is_on))
        rises += is_on and not was_on
        was_on = is_on
    frames = clock.frames or {}
    on_frames = frozenset(frame for frame, is_on in frames.items() if is_on)
    return Recorded(frames=frozenset(frames), on_frames=on_frames, on_s=clock.on_s, rises=rises)


@dataclass(frozen=True, slots=True, kw_only=True)
class Beam:
    """One beam of a fraction; ``seconds`` is its planned beam-on time."""

    number: int
    name: str
    seconds: float


class DeliveredBeams:
    """Delivered beam-on time [s] of each beam, over all sessions of a fraction."""

    def __init__(self, beams: Sequence[Beam]) -> None:
        self._beams = tuple(beams)
        self._delivered_s = [0.0] * len(self._beams)
        self._current = 0

    @property
    def current(self) -> Beam:
        """The beam in delivery."""
        return self._beams[self._current]

    @property
    def is_beam_done(self) -> bool:
        """Whether the current beam has its planned beam-on time."""
        return self._delivered_s[self._current] >= self.current.seconds

    @property
    def is_last(self) -> bool:
        """Whether the current beam is the last."""
        return self._current == len(self._beams) - 1

    @property
    def is_done(self) -> bool:
        """Whether every beam has its planned beam-on time."""
        return self.is_last and self.is_beam_done

    def add(self, seconds: float) -> None:
        """Add beam-on time to the current beam."""
        self._delivered_s[self._current] += seconds

    def next_beam(self) -> None:
        """Make the next beam the current one."""
        self._current += 1

    def reports(self) -> tuple[BeamReport, ...]:
        """Return planned and delivered time of each beam, rounded to 1 ms."""
        return tuple(
            BeamReport(number=beam.number, name=beam.name, planned_s=beam.seconds, delivered_s=round(delivered_s, 3))
            for beam, delivered_s in zip(self._beams, self._delivered_s, strict=True)
        )
