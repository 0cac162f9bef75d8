"""How long the beam was on, as a planning system counts it: from what came over the stream, and from the recorder.

Pure. Times are the camera's own [us], the one clock that the stream and the recorder share. What nobody saw counts as
beam-on where either end of it was: a planning system must not deliver twice what it does not know.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

US_PER_S = 1e6
BEAM_ON = "beam_on"


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """One frame, as far as delivery is concerned."""

    frame_index: int
    timestamp_us: int
    is_on: bool


@dataclass(slots=True)
class BeamClock:
    """Adds beam-on time up, frame by frame; frames that come again or late change nothing.

    Attributes
    ----------
    on_s
        So far.
    unseen_s
        How long frames were missed, so that nobody saw the beam; between two frames without it, it may have been on.
    frames
        Every frame that was seen, and whether the line was on.
    """

    on_s: float = 0.0
    unseen_s: float = 0.0
    last: Seen | None = None
    frames: dict[int, bool] | None = None

    def note(self, seen: Seen) -> float:
        """Take a frame; return by how much the beam-on time grew."""
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
    """What the recorder has of a session."""

    frames: frozenset[int]
    on_s: float
    rises: int


def recorded(rows: Iterable[Mapping[str, str]]) -> Recorded:
    """Read the recorder's rows of a session: the frames, the beam-on time, how often the beam went on."""
    clock, rises, was_on = BeamClock(), 0, False
    for row in rows:
        is_on = row["gate"] == BEAM_ON
        clock.note(Seen(frame_index=int(row["frame_index"]), timestamp_us=int(row["timestamp_us"]), is_on=is_on))
        rises += is_on and not was_on
        was_on = is_on
    return Recorded(frames=frozenset(clock.frames or ()), on_s=clock.on_s, rises=rises)


class EndExhale:
    """Watches some breaths, then tells when the patient is back near the deepest exhale."""

    def __init__(self, *, watch_s: float) -> None:
        self._watch_s = watch_s
        self._since_us: int | None = None
        self._lowest_mm = float("inf")
        self._highest_mm = float("-inf")

    def is_reached(self, timestamp_us: int, motion_mm: float | None) -> bool:
        """Take a frame's motion; None could not be measured."""
        if motion_mm is None:
            return False
        self._since_us = timestamp_us if self._since_us is None else self._since_us
        self._lowest_mm, self._highest_mm = min(self._lowest_mm, motion_mm), max(self._highest_mm, motion_mm)
        near_mm = self._lowest_mm + 0.05 * (self._highest_mm - self._lowest_mm)
        return timestamp_us - self._since_us >= self._watch_s * US_PER_S and motion_mm <= near_mm
