"""How far a method's motion is from the true one, as issue and article judge it.

Every method starts from a frame of its own: its motion and the truth's are both taken against that frame, so that the
noise of the frame used as reference is part of every error. All are judged on the same frames: from where the last of
them has learned.
"""

from dataclasses import dataclass

import numpy as np

from engine.evaluation.outcome import LOST, TRAINING, Outcome, Track
from engine.frames import BoolArray, FloatArray

SILENT_MM = 1.0
COLUMNS = ("plain", "ours", "oracle")


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """One method on one run.

    Attributes
    ----------
    frames
        How many frames it was judged on.
    cells_mm, worst_frame_mm, largest_mm
        Error over the cells of 10 px: the mean over cells and frames, the worst frame's mean over cells, and the
        largest of any cell in any frame.
    whole_mm, whole_worst_mm
        Error of the mean motion of the whole region: mean and largest.
    points_mm, points_max_mm, points_deviation_mm
        Equation 9 at each of the five points: mean, maximum, standard deviation.
    points_correlation
        Correlation of motion with the truth's at the five points, their mean.
    volume_correlation
        Correlation of volume with the volume the skin swept; NaN where the method gives none.
    halves_correlation
        Correlation of thorax with abdomen.
    """

    frames: int
    cells_mm: float
    worst_frame_mm: float
    largest_mm: float
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
    """What Tidegate said of its own frames on one run.

    Attributes
    ----------
    lost_share
        Frames lost, as a share of those after the learning; of all frames where it never learned.
    largest_residual_mm, valid_share
        Largest residual of any frame, and the mean share of the region that was seen.
    wrong, silently_wrong
        Frames in which whole, thorax, abdomen or a point was wrong by 1 mm or more; and those of them that a gate with
        its usual limits would have believed.
    """

    lost_share: float
    largest_residual_mm: float
    valid_share: float
    wrong: int
    silently_wrong: int


def judged_frames(outcome: Outcome) -> BoolArray:
    """Which frames everybody is judged on, shape (n,)."""
    starts = [outcome.tracks[name].reference for name in COLUMNS if name in outcome.tracks]
    begun = [start for start in starts if start is not None]
    first = max(begun, default=len(outcome.timestamp_us))
    return np.arange(len(outcome.timestamp_us)) >= first


def errors(truth: Track, track: Track) -> Track | None:
    """Motion minus true motion, all in mm and l; None where nothing was measured."""
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


def judge(outcome: Outcome, name: str, within: BoolArray | None = None) -> Score | None:
    """Judge one method; None where it measured none of the frames.

    Parameters
    ----------
    within
        Only these frames, shape (n,).
    """
    track = outcome.tracks.get(name)
    error = None if track is None else errors(outcome.truth, track)
    if track is None or error is None:
        return None
    frames = judged_frames(outcome) & track.is_measured
    if within is not None:
        frames &= within
    if not frames.any():
        return None
    cells = np.abs(error.cells_mm[frames])
    points, whole = np.abs(error.points_mm[frames]), np.abs(error.wide_mm[frames, 0])
    truth = outcome.truth
    return Score(
        frames=int(frames.sum()),
        cells_mm=float(np.nanmean(cells)),
        worst_frame_mm=float(np.nanmax(np.nanmean(cells, axis=(1, 2)))),
        largest_mm=float(np.nanmax(cells)),
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


def judge_trust(outcome: Outcome) -> Trust:
    """Compare Tidegate's own doubt with its true errors."""
    track = outcome.tracks["ours"]
    error = errors(outcome.truth, track)
    first = track.reference
    after = np.arange(len(outcome.state)) >= (0 if first is None else first)
    answered = after & (outcome.state != TRAINING) if first is not None else after
    wrong = np.zeros(len(outcome.state), dtype=np.bool_)
    if error is not None:
        largest = np.concatenate([np.abs(error.wide_mm), np.abs(error.points_mm)], axis=1).max(axis=1)
        wrong = track.is_measured & (largest >= SILENT_MM)
    lost = outcome.state == LOST
    return Trust(
        lost_share=float(lost[answered].mean()) if answered.any() else 1.0,
        largest_residual_mm=float(np.nanmax(outcome.residual_mm)) if track.is_measured.any() else float("nan"),
        valid_share=float(np.nanmean(outcome.valid_share)) if track.is_measured.any() else float("nan"),
        wrong=int(wrong.sum()),
        silently_wrong=int((wrong & outcome.is_trusted).sum()),
    )


def correlation(first: FloatArray, second: FloatArray) -> float:
    """Pearson's correlation over the places where both are known; NaN where one does not vary."""
    both = np.isfinite(first) & np.isfinite(second)
    if int(both.sum()) < 3:
        return float("nan")
    one, other = first[both].astype(np.float64), second[both].astype(np.float64)
    a, b = one - one.mean(), other - other.mean()
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / size if size > 0.0 else float("nan")
