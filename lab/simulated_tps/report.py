"""Report of a simulated fraction: a table for the terminal and a JSON file."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

MIN_RECORDED = 0.5
"""Least share of the delivered beam-on time that must be in the record; delivered time includes gaps."""

SCHEMA = "tidegate.simulated-fractions/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamReport:
    """Planned and delivered beam-on time of a beam [s]."""

    number: int
    name: str
    planned_s: float
    delivered_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionReport:
    """One session of a fraction: the live stream compared with the record.

    Attributes
    ----------
    missed_live, unrecorded
        Number of frames recorded but not received live, and received live but not recorded.
    told_missing
        Number of samples that the service reported as dropped for a slow reader or not resent after a break.
    live_on_s, unseen_s
        Beam-on time as counted live, and the part of it in which frames were missed.
    troubles
        Failed checks; empty if all passed.
    """

    session_id: str
    status: str
    live_frames: int
    recorded_frames: int
    missed_live: int
    told_missing: int
    unrecorded: int
    live_on_s: float
    recorded_on_s: float
    unseen_s: float
    beam_edges: int
    audit_rows: int
    troubles: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class FractionReport:
    """Result of a fraction; the field names are keys of the JSON report."""

    number: int
    outcome: str
    seconds: float
    beams: tuple[BeamReport, ...]
    stretches: tuple[SessionReport, ...]
    holds: dict[str, int] = field(default_factory=dict)
    faults: tuple[str, ...] = ()
    acknowledged: int = 0
    lost_answers: int = 0

    @property
    def is_good(self) -> bool:
        """Whether every beam was delivered and every check passed."""
        return self.outcome == "delivered" and not self.all_troubles

    @property
    def troubles(self) -> tuple[str, ...]:
        """Failed checks of the whole fraction: no session, no beam, too little delivered or recorded."""
        return tuple(self._troubles())

    @property
    def all_troubles(self) -> tuple[str, ...]:
        """Failed checks of the whole fraction and of each session."""
        return (*self.troubles, *(one for session in self.stretches for one in session.troubles))

    def _troubles(self) -> Iterator[str]:
        if not self.stretches:
            yield "no session was run"
        if not self.beams:
            yield "no beam was planned"
            return
        for beam in self.beams:
            if beam.delivered_s < beam.planned_s:
                yield f"beam {beam.number}: {beam.delivered_s:.2f} s of {beam.planned_s:.2f} s were delivered"
        delivered_s = sum(beam.delivered_s for beam in self.beams)
        recorded_s = sum(session.recorded_on_s for session in self.stretches)
        if not any(session.live_on_s for session in self.stretches):
            yield "no beam was seen live"
        if not recorded_s:
            yield "no beam was recorded"
        elif recorded_s < MIN_RECORDED * delivered_s:
            yield f"{recorded_s:.1f} s of beam were recorded, and {delivered_s:.1f} s counted as delivered"


def write_report(path: Path, fractions: Sequence[FractionReport], *, plan: str, chaos: dict[str, int]) -> None:
    """Write the reports as JSON; ``chaos`` counts the injected faults."""
    document = {
        "schema": SCHEMA,
        "plan": plan,
        "is_good": bool(fractions) and all(one.is_good for one in fractions),
        "chaos": chaos,
        "fractions": [{**asdict(one), "troubles": one.troubles, "is_good": one.is_good} for one in fractions],
    }
    path.write_text(json.dumps(document, indent=1) + "\n")


def fraction_table(fraction: FractionReport) -> "Table":
    """Return a table of the fraction for the terminal."""
    from rich.table import Table

    table = Table(title=f"Fraction {fraction.number}: {fraction.outcome}", title_justify="left", show_header=False)
    for beam in fraction.beams:
        seconds = f"{beam.delivered_s:.2f} s of {beam.planned_s:.2f} s"
        table.add_row(f"beam {beam.number} {beam.name}", seconds)
    table.add_row("check", "; ".join(fraction.troubles) or "delivered as planned")
    for session in fraction.stretches:
        table.add_row(f"session {session.session_id[:8]}", session.status)
        frames = f"{session.live_frames} live, {session.recorded_frames} recorded, {session.missed_live} missed live"
        table.add_row("  frames", f"{frames}, {session.unrecorded} not recorded")
        on_time = f"{session.live_on_s:.3f} s live, {session.recorded_on_s:.3f} s recorded"
        table.add_row("  beam on", f"{on_time}, {session.unseen_s:.3f} s unseen")
        table.add_row("  beam edges", f"{session.beam_edges} in the gate's transitions")
        table.add_row("  check", "; ".join(session.troubles) or "all checks passed")
    table.add_row("holds", ", ".join(f"{reason} {count}" for reason, count in fraction.holds.items()) or "none")
    table.add_row("faults", ", ".join(fraction.faults) or "none")
    table.add_row("answers lost", str(fraction.lost_answers))
    return table
