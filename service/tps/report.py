"""What a simulated fraction came to: for a terminal as a table, for a program as JSON."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

SCHEMA = "tidegate.simulated-fractions/1"


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamReport:
    """A beam, and what the planning system counted of it."""

    number: int
    name: str
    planned_s: float
    delivered_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class StretchReport:
    """One session of a fraction: what was seen of it live, held against what was recorded.

    Attributes
    ----------
    missed_live, unrecorded
        Frames that were recorded and never seen, and seen and never recorded.
    told_missing
        How many samples the service said that it left out, of a slow reader or behind a break.
    live_on_s, unseen_s
        Beam-on time as counted live, and the part of it in which frames were missed.
    troubles
        What does not fit; empty when all does.
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
    """A fraction, from its preparation to its check."""

    number: int
    outcome: str
    seconds: float
    beams: tuple[BeamReport, ...]
    stretches: tuple[StretchReport, ...]
    holds: dict[str, int] = field(default_factory=dict)
    faults: tuple[str, ...] = ()
    acknowledged: int = 0
    lost_answers: int = 0

    @property
    def is_good(self) -> bool:
        """Whether all was delivered, and everything fits."""
        return self.outcome == "delivered" and not any(stretch.troubles for stretch in self.stretches)


def write_report(path: Path, fractions: Sequence[FractionReport], *, plan: str, chaos: dict[str, int]) -> None:
    """Write all of it as JSON."""
    document = {
        "schema": SCHEMA,
        "plan": plan,
        "is_good": all(one.is_good for one in fractions),
        "chaos": chaos,
        "fractions": [{**asdict(one), "is_good": one.is_good} for one in fractions],
    }
    path.write_text(json.dumps(document, indent=1) + "\n")


def fraction_table(fraction: FractionReport) -> "Table":
    """Lay a fraction out for a terminal."""
    from rich.table import Table

    table = Table(title=f"Fraction {fraction.number}: {fraction.outcome}", title_justify="left", show_header=False)
    for beam in fraction.beams:
        told = f"{beam.delivered_s:.2f} s of {beam.planned_s:.2f} s"
        table.add_row(f"beam {beam.number} {beam.name}", told)
    for stretch in fraction.stretches:
        table.add_row(f"session {stretch.session_id[:8]}", stretch.status)
        frames = f"{stretch.live_frames} live, {stretch.recorded_frames} recorded, {stretch.missed_live} missed live"
        table.add_row("  frames", f"{frames}, {stretch.unrecorded} never recorded")
        on_time = f"{stretch.live_on_s:.3f} s live, {stretch.recorded_on_s:.3f} s recorded"
        table.add_row("  beam on", f"{on_time}, {stretch.unseen_s:.3f} s unseen")
        table.add_row("  beam edges", f"{stretch.beam_edges}, as the gate's transitions say")
        table.add_row("  check", "; ".join(stretch.troubles) or "everything fits")
    table.add_row("holds", ", ".join(f"{reason} {count}" for reason, count in fraction.holds.items()) or "none")
    table.add_row("faults", ", ".join(fraction.faults) or "none")
    table.add_row("answers lost", str(fraction.lost_answers))
    return table
