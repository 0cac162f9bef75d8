"""Table of the gate-edge timing: every window's edges against the true ones, over all recordings.

Tables of the gate's rules on breathing: false holds on recorded courses, and what the rules stop on made ones.
"""

from collections.abc import Sequence

import numpy as np

from engine.core.frames import BoolArray
from engine.offline.signal_gate import FPS
from lab.evaluation.gating.breathing_rules import RULES, GatedCourse, StoppedTrial
from lab.evaluation.gating.timing import EdgeTiming
from lab.evaluation.table import Cell, Table

TOLERANCE_MS = 10.0
MAX_FALSE_PERCENT = 1.0
PERCENT = 100.0


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


def recorded_table(window: str, courses: Sequence[GatedCourse]) -> Table:
    """Return one row per course and one of all; that of all fails where the rules hold too many honest frames."""
    rows = [_recorded_row(course.name, [course]) for course in courses]
    rows += [_recorded_row("all", courses)] if courses else []
    false_percent = sum(float(cell) for cell in rows[-1][3:6] if isinstance(cell, float)) if rows else 0.0
    return Table(
        name=f"gate_rules_{window.replace(' ', '_')}",
        title=f"Rules on breathing, recorded courses, {window} window",
        columns=(
            *("course", "seconds", "honest [%]"),
            *(f"honest, held by {name} [%]" for name in RULES.values()),
            *("honest, beam on [%]", "elsewhere [%]", "elsewhere, beam on [%]", "without the rules [%]"),
        ),
        rows=tuple(rows),
        failed=frozenset() if false_percent <= MAX_FALSE_PERCENT else frozenset({len(courses)}),
        note="Honest: the patient breathes, and the ends of exhale before and after lie within the drift's bound. "
        "Elsewhere: both lie beyond it. The baseline is never corrected, so a patient who has drifted stays elsewhere. "
        f"Mark: at most {MAX_FALSE_PERCENT:g} % of all honest time is held by these rules where the beam would be on.",
    )


def _recorded_row(name: str, courses: Sequence[GatedCourse]) -> tuple[Cell, ...]:
    honest = np.concatenate([course.is_honest for course in courses])
    elsewhere = np.concatenate([course.is_elsewhere for course in courses])
    is_on = np.concatenate([course.is_on for course in courses])
    would_be_on = np.concatenate([course.would_be_on for course in courses])
    held = {reason: np.concatenate([course.is_held_by(reason) for course in courses]) for reason in RULES}
    return (
        name,
        round(len(honest) / FPS),
        _percent(honest),
        *(_percent(held[reason], honest) for reason in RULES),
        _percent(is_on, honest),
        _percent(elsewhere),
        _percent(is_on, elsewhere),
        _percent(would_be_on, elsewhere),
    )


def _percent(values: BoolArray, among: BoolArray | None = None) -> float | None:
    chosen = values if among is None else values[among]
    return PERCENT * float(chosen.mean()) if chosen.size else None


def stopped_table(trials: Sequence[StoppedTrial]) -> Table:
    """Return one row per kind of trial: longest beam-on and largest drift with it, with the rules and without."""
    kinds = list(dict.fromkeys(trial.kind for trial in trials))
    return Table(
        name="gate_rules_trials",
        title="Rules on breathing, made courses: beam-on after the event has begun",
        columns=(
            *("event", "trials", "beam-on, median [s]", "longest [s]", "longest without the rules [s]"),
            *("largest drift with beam [mm]", "without the rules [mm]"),
        ),
        rows=tuple(_stopped_row(kind, [trial for trial in trials if trial.kind == kind]) for kind in kinds),
        note="Beam-on is the longest stay of each trial. The drift is how far the made course has moved.",
    )


def _stopped_row(kind: str, trials: Sequence[StoppedTrial]) -> tuple[Cell, ...]:
    on_s = [trial.on_s for trial in trials]
    drifts = [trial.drift_mm for trial in trials if trial.drift_mm is not None]
    free = [trial.free_drift_mm for trial in trials if trial.free_drift_mm is not None]
    return (
        kind,
        len(trials),
        float(np.median(on_s)),
        max(on_s),
        max(trial.free_on_s for trial in trials),
        max(drifts) if drifts else None,
        max(free) if free else None,
    )
