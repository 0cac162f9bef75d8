"""The gate-edge timing as a table: every window's edges against the truth's, over all recordings."""

import numpy as np

from engine.evaluation.gate_timing import EdgeTiming
from engine.evaluation.tables import Cell, Table

ALLOWED_BESIDE_A_FRAME_MS = 10.0


def mark_ms(fps: float) -> float:
    """Return how late an edge may be: a frame's time, and 10 ms [ms]."""
    return 1000.0 / fps + ALLOWED_BESIDE_A_FRAME_MS


def gate_table(timings: list[EdgeTiming], fps: float) -> Table:
    """Lay out every window's edges, those in red that are later than a frame and 10 ms, or that were not found."""
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
            "beyond the window then, worst [mm or l]",
        ),
        rows=tuple(rows),
        digits=2,
        failed=frozenset(number for number, row in enumerate(rows) if not _is_met(row, fps)),
        note="Positive is late. From the true crossing, and the dwell where the beam goes on, to the gate's decision: "
        "a frame's sampling, the measurement's error and its computing time are in it, the camera's own delay and the "
        "beam line's are not. Missed edges should have been and were not, extra ones the other way round.",
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
