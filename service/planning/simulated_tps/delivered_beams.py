"""The current beam and the delivered beam-on time of each beam, as a record-and-verify system counts them."""

from collections.abc import Sequence
from dataclasses import dataclass

from service.planning.simulated_tps.report import BeamReport


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
