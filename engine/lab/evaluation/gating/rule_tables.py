"""Tables of the gate's rules on breathing: false holds on recorded courses, and what the rules stop on made ones."""

from collections.abc import Sequence

import numpy as np

from engine.core.frames import BoolArray
from engine.lab.evaluation.gating.breathing_rules import FPS, RULES, GatedCourse
from engine.lab.evaluation.gating.rule_trials import StoppedTrial
from engine.lab.evaluation.table import Cell, Table

MAX_FALSE_PERCENT = 1.0
PERCENT = 100.0


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
