"""Errors of a method's motion against the truth (article, equation 9).

Every method has its own reference frame. Its motion and the true motion are both relative to that frame, so the noise
of the reference frame is part of every error. All methods are scored on the same frames: those after the last method
has finished training.

Runs with their scores, the input of tables and figures.
"""

from dataclasses import dataclass

import numpy as np

from engine.core.frames import BoolArray, FloatArray
from lab.evaluation.methods.outcome import LOST, TRAINING, Outcome, Track
from lab.evaluation.runs.datasets import Run

LEAST_MOTION_MM = 0.5
SILENT_MM = 1.0
COLUMNS = ("plain", "ours", "oracle")
WHOLE = ("smoothed", "offline")
EVENTS = {"isovolume": "isovolume", "dibh": "hold"}
"""Events whose frames a scenario is scored on; a patient shift is scored after the shift."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """Errors of one method on one run.

    Attributes
    ----------
    frames
        Number of scored frames.
    cells_mm, worst_frame_mm, largest_mm
        Absolute error over the cells of 10 px: mean over cells and frames, mean over cells of the worst frame, and
        maximum over cells and frames.
    constants_out_mm, gains_out_mm
        As ``cells_mm``, with each cell's constant taken off (its share of the reference), and with its gain too.
    whole_mm, whole_worst_mm
        Absolute error of the whole region's mean motion: mean and maximum.
    points_mm, points_max_mm, points_deviation_mm
        Equation 9 at each of the five points: mean, maximum, standard deviation.
    points_correlation
        Correlation of measured with true motion, mean of the five points.
    volume_correlation
        Correlation of the volume with the true one; NaN if the method gives none.
    halves_correlation
        Correlation of thorax with abdomen.
    """

    frames: int
    cells_mm: float
    worst_frame_mm: float
    largest_mm: float
    constants_out_mm: float
    gains_out_mm: float
    whole_mm: float
    whole_worst_mm: float
    points_mm: tuple[float, ...]
    points_max_mm: tuple[float, ...]
    points_deviation_mm: tuple[float, ...]
    points_correlation: float
    volume_correlation: float
    halves_correlation: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Trust:
    """Tidegate's own quality figures on one run, compared with its true errors.

    Attributes
    ----------
    lost_share
        Share of lost frames after training; of all frames if no model was learned.
    largest_residual_mm, valid_share
        Largest residual of any frame, and mean share of the region with a reading.
    wrong, silently_wrong
        Number of frames with an error of 1 mm or more in whole, thorax, abdomen or a point; and of those among them
        that pass the frame checks with the gate's default limits.
    """

    lost_share: float
    largest_residual_mm: float
    valid_share: float
    wrong: int
    silently_wrong: int


def scored_frames(outcome: Outcome) -> BoolArray:
    """Frames that all methods are scored on, shape (n,)."""
    starts = [outcome.tracks[name].reference for name in COLUMNS if name in outcome.tracks]
    begun = [start for start in starts if start is not None]
    first = max(begun, default=len(outcome.timestamp_us))
    return np.arange(len(outcome.timestamp_us)) >= first


def errors(truth: Track, track: Track) -> Track | None:
    """Measured less true motion [mm, l]; None if the method measured no frame."""
    first = track.reference
    if first is None:
        return None
    return Track(
        cells_mm=track.cells_mm - (truth.cells_mm[first] - truth.cells_mm),
        wide_mm=track.wide_mm - (truth.wide_mm[first] - truth.wide_mm),
        points_mm=track.points_mm - (truth.points_mm[first] - truth.points_mm),
        volume_l=track.volume_l - (truth.volume_l - truth.volume_l[first]),
        beta=track.beta,
    )


def score_method(
    outcome: Outcome, name: str, within: BoolArray | None = None, *, is_whole: bool = False
) -> Score | None:
    """Compute the score of one method; None if it measured none of the frames.

    Parameters
    ----------
    within
        Restricts the scored frames, shape (n,).
    is_whole
        Every frame that it measured, not only those behind the last method's training.
    """
    track = outcome.tracks.get(name)
    error = None if track is None else errors(outcome.truth, track)
    if track is None or error is None:
        return None
    frames = track.is_measured if is_whole else scored_frames(outcome) & track.is_measured
    if within is not None:
        frames &= within
    if not frames.any():
        return None
    cells = np.abs(error.cells_mm[frames])
    _, constants_out_mm, gains_out_mm = cell_errors_mm(error.cells_mm[frames], outcome.truth.cells_mm[frames])
    points, whole = np.abs(error.points_mm[frames]), np.abs(error.wide_mm[frames, 0])
    truth = outcome.truth
    return Score(
        frames=int(frames.sum()),
        cells_mm=float(np.nanmean(cells)),
        worst_frame_mm=float(np.nanmax(np.nanmean(cells, axis=(1, 2)))),
        largest_mm=float(np.nanmax(cells)),
        constants_out_mm=constants_out_mm,
        gains_out_mm=gains_out_mm,
        whole_mm=float(whole.mean()),
        whole_worst_mm=float(whole.max()),
        points_mm=tuple(points.mean(axis=0).tolist()),
        points_max_mm=tuple(points.max(axis=0).tolist()),
        points_deviation_mm=tuple(points.std(axis=0).tolist()),
        points_correlation=float(
            np.mean([correlation(track.points_mm[frames, i], -truth.points_mm[frames, i]) for i in range(5)])
        ),
        volume_correlation=correlation(track.volume_l[frames], truth.volume_l[frames]),
        halves_correlation=correlation(track.wide_mm[frames, 1], track.wide_mm[frames, 2]),
    )


def cell_errors_mm(errors_mm: FloatArray, depth_mm: FloatArray) -> tuple[float, float, float]:
    """Mean absolute error of the cells, with each one's constant taken off, and with its gain too.

    ``errors_mm`` and the true ``depth_mm`` have the shape (n, rows, columns).
    """
    mean_mm = float(np.nanmean(np.abs(errors_mm)))
    return mean_mm, _left_mm(errors_mm), _left_mm(_without_gain(errors_mm, depth_mm))


def _left_mm(errors_mm: FloatArray) -> float:
    """Mean absolute error of the cells without the mean of each, of errors of shape (n, rows, columns)."""
    return float(np.nanmean(np.abs(errors_mm - _means(errors_mm))))


def _means(values: FloatArray) -> FloatArray:
    """Mean of each cell over the frames; NaN for a cell that was never measured."""
    counts = np.isfinite(values).sum(axis=0)
    return np.where(counts > 0, np.nansum(values, axis=0) / np.maximum(counts, 1), np.nan)


def cell_gains(errors_mm: FloatArray, depth_mm: FloatArray) -> FloatArray:
    """Return the error of each cell per true motion, of the cells that move by half a millimetre or more."""
    motion_mm, gains = _gains(errors_mm, depth_mm)
    moving_mm = np.sqrt(np.nansum(np.square(motion_mm), axis=0) / np.maximum(np.isfinite(motion_mm).sum(axis=0), 1))
    return np.asarray(gains[moving_mm >= LEAST_MOTION_MM])


def _without_gain(errors_mm: FloatArray, depth_mm: FloatArray) -> FloatArray:
    """Take off each cell's error that is proportional to its true motion."""
    motion_mm, gains = _gains(errors_mm, depth_mm)
    return np.asarray(errors_mm - gains * motion_mm)


def _gains(errors_mm: FloatArray, depth_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the true motion where a cell was measured, shape (n, rows, columns), and each cell's error per motion."""
    motion_mm = np.where(np.isfinite(errors_mm), depth_mm - depth_mm.mean(axis=0), np.nan)
    energy = np.maximum(np.nansum(motion_mm**2, axis=0), 1e-9)
    return motion_mm, np.asarray(np.nansum((errors_mm - _means(errors_mm)) * motion_mm, axis=0) / energy)


def assess_trust(outcome: Outcome) -> Trust:
    """Compare Tidegate's own quality figures with its true errors."""
    track = outcome.tracks["ours"]
    error = errors(outcome.truth, track)
    first = track.reference
    after = np.arange(len(outcome.state)) >= (0 if first is None else first)
    measured_or_lost = after & (outcome.state != TRAINING) if first is not None else after
    wrong = np.zeros(len(outcome.state), dtype=np.bool_)
    if error is not None:
        largest = np.concatenate([np.abs(error.wide_mm), np.abs(error.points_mm)], axis=1).max(axis=1)
        wrong = track.is_measured & (largest >= SILENT_MM)
    lost = outcome.state == LOST
    return Trust(
        lost_share=float(lost[measured_or_lost].mean()) if measured_or_lost.any() else 1.0,
        largest_residual_mm=float(np.nanmax(outcome.residual_mm)) if track.is_measured.any() else float("nan"),
        valid_share=float(np.nanmean(outcome.valid_share)) if track.is_measured.any() else float("nan"),
        wrong=int(wrong.sum()),
        silently_wrong=int((wrong & outcome.is_trusted).sum()),
    )


def correlation(first: FloatArray, second: FloatArray) -> float:
    """Pearson's correlation where both are finite; NaN if one is constant or there are fewer than three values."""
    both = np.isfinite(first) & np.isfinite(second)
    if int(both.sum()) < 3:
        return float("nan")
    one, other = first[both].astype(np.float64), second[both].astype(np.float64)
    a, b = one - one.mean(), other - other.mean()
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / size if size > 0.0 else float("nan")


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
    whole_scores
        By method that measures a recording whole: over every frame, with its share in ``whole_share``.
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
    whole_scores: dict[str, Score]
    whole_share: dict[str, float]
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
    whole = {name: score for name in WHOLE if (score := score_method(outcome, name, is_whole=True)) is not None}
    maps = {name: cell_map for name in COLUMNS if (cell_map := _cell_map(outcome, name)) is not None}
    scored = ScoredRun(
        run=run,
        outcome=outcome,
        frames=scored_frames(outcome),
        scores=scores,
        event_scores=event_scores,
        whole_scores=whole,
        whole_share={name: score.frames / len(outcome.timestamp_us) for name, score in whole.items()},
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
