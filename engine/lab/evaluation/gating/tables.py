"""Table of the gate-edge timing: every window's edges against the true ones, over all recordings."""

import numpy as np

from engine.lab.evaluation.gating.timing import EdgeTiming
from engine.lab.evaluation.table import Cell, Table

TOLERANCE_MS = 10.0


def mark_ms(fps: float) -> float:
    """Return the largest accepted delay of an edge: one frame period plus 10 ms [ms]."""
    return 1000.0 / fps + TOLERANCE_MS


def gate_table(timings: list[EdgeTiming], fps: float) -> Table:
    """Return one row per window and direction; rows with late, missed or extra edges are marked as failed."""
    kinds = list(dict.fromkeys((timing.kind, timing.is_on) for timing in timings))
    rows = [_row(kind, [timing for timing in timings if (timing.kind, timing.is_on) == kind]) for kind in kinds]
    return Table(
        name="gate_edges",
        title=f"Gate edges against the truth [ms]: at most {mark_ms(fps):.1f}, a frame and 10 ms",
        columns=(
            "window",
            "beam goes",
            "edges",
            "missed",
            "extra",
            "earliest",
            "median",
            "p95",
            "latest",
            "largest excursion at beam off [mm or l]",
        ),
        rows=tuple(rows),
        digits=2,
        failed=frozenset(number for number, row in enumerate(rows) if not _is_met(row, fps)),
        note="Positive is late. From the true crossing, plus the dwell for beam on, to the gate's decision: includes "
        "frame sampling, the measurement's error and its computing time, but not the delays of camera and beam "
        "line. Missed edges are true edges without a decision, extra ones are decisions without a true edge.",
    )


def _row(kind: tuple[str, bool], timings: list[EdgeTiming]) -> tuple[Cell, ...]:
    name, is_on = kind
    delays = np.concatenate([timing.delays_ms for timing in timings])
    beyond = np.concatenate([timing.beyond for timing in timings])
    beyond = beyond[np.isfinite(beyond)]
    figures: list[Cell] = [None] * 4
    if delays.size:
        figures = [float(value) for value in np.percentile(delays, [0.0, 50.0, 95.0, 100.0])]
    return (
        name,
        "on" if is_on else "off",
        int(delays.size),
        sum(timing.missed for timing in timings),
        sum(timing.extra for timing in timings),
        *figures,
        float(beyond.max()) if beyond.size else None,
    )


def _is_met(row: tuple[Cell, ...], fps: float) -> bool:
    latest = row[8]
    return isinstance(latest, float) and latest <= mark_ms(fps) and row[3] == row[4] == 0
