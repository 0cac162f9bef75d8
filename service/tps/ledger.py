"""Which beam is delivered, and how much of each: what a record-and-verify system keeps."""

from collections.abc import Sequence
from dataclasses import dataclass

from service.tps.report import BeamReport


@dataclass(frozen=True, slots=True, kw_only=True)
class Beam:
    """One beam of a fraction."""

    number: int
    name: str
    seconds: float


class Ledger:
    """Seconds of beam-on time, beam by beam, over all sessions of a fraction."""

    def __init__(self, beams: Sequence[Beam]) -> None:
        self._beams = tuple(beams)
        self._delivered_s = [0.0] * len(self._beams)
        self._current = 0

    @property
    def current(self) -> Beam:
        """The beam that is delivered now."""
        return self._beams[self._current]

    @property
    def is_beam_done(self) -> bool:
        """Whether the beam of now has had its time."""
        return self._delivered_s[self._current] >= self.current.seconds

    @property
    def is_last(self) -> bool:
        """Whether no beam comes after this one."""
        return self._current == len(self._beams) - 1

    @property
    def is_done(self) -> bool:
        """Whether every beam has had its time."""
        return self.is_last and self.is_beam_done

    def add(self, seconds: float) -> None:
        """Put beam-on time down to the beam of now."""
        self._delivered_s[self._current] += seconds

    def next_beam(self) -> None:
        """Go on to the next beam."""
        self._current += 1

    def reports(self) -> tuple[BeamReport, ...]:
        """Tell each beam."""
        return tuple(
            BeamReport(number=beam.number, name=beam.name, planned_s=beam.seconds, delivered_s=round(delivered_s, 3))
            for beam, delivered_s in zip(self._beams, self._delivered_s, strict=True)
        )
