"""Runs with their scores, the input of tables and figures."""

from dataclasses import dataclass

import numpy as np

from engine.core.frames import BoolArray, FloatArray
from engine.lab.evaluation.methods.outcome import Outcome
from engine.lab.evaluation.runs.datasets import Run
from engine.lab.evaluation.runs.scores import (
    COLUMNS,
    Score,
    Trust,
    assess_trust,
    errors,
    score_method,
    scored_frames,
)

EVENTS = {"isovolume": "isovolume", "dibh": "hold"}
"""Events whose frames a scenario is scored on; a patient shift is scored after the shift."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScoredRun:
    """A run, its measurements and their scores.

    Attributes
    ----------
    outcome
        The measurements without the cells, which take most of the memory.
    frames
        Scored frames, shape (n,).
    scores, event_scores
        By method: over all frames after training, and over the frames of the scenario's event (all, if it has none).
    trust
        Tidegate's own residuals and lost frames, compared with its true errors.
    cell_maps_mm
        By method: mean error of each cell [mm], shape (35, 20).
    """

    run: Run
    outcome: Outcome
    frames: BoolArray
    scores: dict[str, Score]
    event_scores: dict[str, Score]
    trust: Trust
    cell_maps_mm: dict[str, FloatArray]

    def true_motion(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Return the true motion from a method's reference frame [mm]: wide, shape (n, 3), and points, shape (n, 5)."""
        first = self.outcome.tracks[name].reference or 0
        truth = self.outcome.truth
        return truth.wide_mm[first] - truth.wide_mm, truth.points_mm[first] - truth.points_mm


def score_run(run: Run, outcome: Outcome) -> ScoredRun:
    """Score every method on a run, and release the cells."""
    event = event_frames(run, outcome)
    scores = {name: score for name in outcome.tracks if (score := score_method(outcome, name)) is not None}
    event_scores = {name: score for name in outcome.tracks if (score := score_method(outcome, name, event)) is not None}
    maps = {name: cell_map for name in COLUMNS if (cell_map := _cell_map(outcome, name)) is not None}
    scored = ScoredRun(
        run=run,
        outcome=outcome,
        frames=scored_frames(outcome),
        scores=scores,
        event_scores=event_scores,
        trust=assess_trust(outcome),
        cell_maps_mm=maps,
    )
    for track in (outcome.truth, *outcome.tracks.values()):
        track.cells_mm = np.zeros((0, 0, 0), dtype=np.float32)
    return scored


def event_frames(run: Run, outcome: Outcome) -> BoolArray:
    """Frames of the scenario's event, shape (n,)."""
    if run.scenario in EVENTS:
        return outcome.within(EVENTS[run.scenario])
    if run.scenario == "shift":
        ends = [event["end_us"] for event in outcome.events if event["name"] == "shift"]
        return np.asarray(outcome.timestamp_us >= min(ends, default=0))
    return np.ones(len(outcome.timestamp_us), dtype=np.bool_)


def _cell_map(outcome: Outcome, name: str) -> FloatArray | None:
    if name not in outcome.tracks:
        return None
    track = outcome.tracks[name]
    error, frames = errors(outcome.truth, track), scored_frames(outcome) & track.is_measured
    if error is None or not frames.any():
        return None
    known = np.isfinite(error.cells_mm[frames])
    total = np.where(known, np.abs(error.cells_mm[frames]), 0.0).sum(axis=0)
    counts = known.sum(axis=0)
    return np.where(counts > 0, total / np.maximum(counts, 1), np.nan)
