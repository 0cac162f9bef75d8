"""Beam-on time as a planning system counts it, from the stream and from the recorder.

Pure. Times are camera timestamps [us], the clock that the stream and the recorder share. A gap counts as beam-on if the
beam was on at either end of it: a planning system must not deliver a dose twice because frames are missing.

The current beam and the delivered beam-on time of each beam, as a record-and-verify system counts them.

A client that injects faults by a seed: lost answers, repeated calls, a broken stream, slow reading.
"""

import random
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from lab.simulated_tps.report import BeamReport
from service.client import AnsweredCall, LiveMessage, SentCall, TidegateClient

US_PER_S = 1e6
BEAM_ON = "beam_on"
BREAK_PROBABILITY = 1 / 400
SLOW_READ_PROBABILITY = 1 / 300
SLOW_READ_S = (0.3, 1.5)
FAULTS = ("answer lost", "never sent", "sent twice")
FAULT_PROBABILITY = 0.3
RETRIES = 8
"""One attempt in five fails: this many consecutive failures are practically impossible."""


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


class FaultInjectingClient(TidegateClient):
    """Injects faults into its own calls; `counts` holds the number of each kind."""

    def __init__(
        self,
        base_url: str,
        *,
        seed: int,
        key: str | None = None,
        operator: str | None = None,
        ca_file: str | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(base_url, key=key, operator=operator, ca_file=ca_file, retries=RETRIES)
        self._random = random.Random(seed)  # noqa: S311 - not cryptographic
        self._sleep = sleep
        self.counts: Counter[str] = Counter()

    def _once(self, call: SentCall) -> AnsweredCall:
        if self._random.random() >= FAULT_PROBABILITY:
            return super()._once(call)
        fault = self._random.choice(FAULTS)
        if fault == "sent twice" and not call.is_repeatable:
            return super()._once(call)
        self.counts[fault] += 1
        if fault == "never sent":
            raise ConnectionResetError("chaos: the request was never sent")
        super()._once(call)
        if fault == "sent twice":
            return super()._once(call)
        raise ConnectionResetError("chaos: the answer was lost")

    def live(
        self,
        *,
        session_id: str | None = None,
        after_frame: int | None = None,
        rate_hz: float | None = None,
        form: Literal["full", "thin"] = "thin",
        silence_s: float = 5.0,
        reconnects: int = 8,
    ) -> Iterator[LiveMessage]:
        """Follow the stream; break the connection and read slowly at random, then resume."""
        last = after_frame
        while True:
            stream = super().live(
                session_id=session_id,
                after_frame=last,
                rate_hz=rate_hz,
                form=form,
                silence_s=silence_s,
                reconnects=reconnects,
            )
            for message in stream:
                yield message
                if message["type"] == "sample" and message["session_id"] == session_id:
                    last = message["frame_index"]
                if self._random.random() < SLOW_READ_PROBABILITY:
                    self.counts["read slowly"] += 1
                    self._sleep(self._random.uniform(*SLOW_READ_S))
                if self._random.random() < BREAK_PROBABILITY:
                    self.counts["stream broken"] += 1
                    break
