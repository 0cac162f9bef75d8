"""A run with its scores; what tables and figures are made of."""

from dataclasses import dataclass

import numpy as np

from engine.evaluation.datasets import Run
from engine.evaluation.outcome import Outcome
from engine.evaluation.scores import COLUMNS, Score, Trust, errors, judge, judge_trust, judged_frames
from engine.frames import BoolArray, FloatArray

EVENTS = {"isovolume": "isovolume", "dibh": "hold"}
"""What a scenario is judged on: frames within these events; a shifted patient is judged after the shift."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Judged:
    """A run, what was measured, and how good it was.

    Attributes
    ----------
    outcome
        Without the cells, which take most of the room.
    scores, event_scores
        By method: over all frames after the learning, and over those the scenario is about (the same where it is about
        none in particular).
    cell_maps_mm
        By method: mean error of each cell, shape (35, 20).
    """

    run: Run
    outcome: Outcome
    frames: BoolArray
    scores: dict[str, Score]
    event_scores: dict[str, Score]
    trust: Trust
    cell_maps_mm: dict[str, FloatArray]

    def true_motion(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Return the truth against the method's own reference frame: wide, shape (n, 3), and points, shape (n, 5)."""
        first = self.outcome.tracks[name].reference or 0
        truth = self.outcome.truth
        return truth.wide_mm[first] - truth.wide_mm, truth.points_mm[first] - truth.points_mm


def judge_run(run: Run, outcome: Outcome) -> Judged:
    """Judge every method on a run, and let go of the cells."""
    event = event_frames(run, outcome)
    scores = {name: score for name in outcome.tracks if (score := judge(outcome, name)) is not None}
    event_scores = {name: score for name in outcome.tracks if (score := judge(outcome, name, event)) is not None}
    maps = {name: cell_map for name in COLUMNS if (cell_map := _cell_map(outcome, name)) is not None}
    judged = Judged(
        run=run,
        outcome=outcome,
        frames=judged_frames(outcome),
        scores=scores,
        event_scores=event_scores,
        trust=judge_trust(outcome),
        cell_maps_mm=maps,
    )
    for track in (outcome.truth, *outcome.tracks.values()):
        track.cells_mm = np.zeros((0, 0, 0), dtype=np.float32)
    return judged


def event_frames(run: Run, outcome: Outcome) -> BoolArray:
    """Which frames the scenario is about, shape (n,)."""
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
    error, frames = errors(outcome.truth, track), judged_frames(outcome) & track.is_measured
    if error is None or not frames.any():
        return None
    known = np.isfinite(error.cells_mm[frames])
    total = np.where(known, np.abs(error.cells_mm[frames]), 0.0).sum(axis=0)
    counts = known.sum(axis=0)
    return np.where(counts > 0, total / np.maximum(counts, 1), np.nan)
