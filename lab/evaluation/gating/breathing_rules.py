"""The gate's rules on breathing, on courses of one signal: drift of the baseline, ceased breathing, longest beam-on.

Each course is gated twice on the same frames: by the default limits, and without these rules. The reference is the end
of exhale of the last three breaths of the first 20 s, in which the breathing range is learned; the gate is armed then.
The signal stands for the whole region, so what is evaluated are the rules, not the measurement.

Made courses in which a rule on breathing has to end the beam: ceased breathing, pictures that stand still, drift.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from engine.core.frames import BoolArray, FloatArray
from engine.core.gate_state import HoldReason
from engine.gating.limits import GateLimits
from engine.gating.supervision.patient_shift import BREATH_SHARE, HALF
from engine.gating.windows import AmplitudeWindow
from engine.offline.signal_gate import FPS, gate_frames, learn_signal
from engine.qa.recorded_traces import read_trace
from lab.evaluation.breathing.bench import DRIFTS_MM_S, FIRST_SEED
from lab.evaluation.breathing.trials import make_trial

LEARN_S = 20.0
SMOOTHING_S = 0.3
LONGEST_PERIODS = 2.0
PROMINENCE_SHARE = 0.25
EXHALE = (-60.0, 35.0)
WINDOWS = {"exhale": EXHALE, "narrow exhale": (-15.0, 25.0)}
"""Edges in per cent of the learned range."""
RULES = {
    HoldReason.BASELINE_DRIFTED: "drift",
    HoldReason.BREATHING_IRREGULAR: "ceased",
    HoldReason.BEAM_ON_LIMIT: "beam-on limit",
}
INHALE = (60.0, 180.0)
SECONDS = 80.0
STOPS_S = 45.0
SLIDE_MM_S = 0.7
VOLUNTEERS = (1, 3, 5, 7, 9)
TRIALS_EACH = 5 + 2 * len(DRIFTS_MM_S)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GatedCourse:
    """A course after learning, gated with and without the rules; arrays of shape (n,), one value a frame.

    Attributes
    ----------
    time_s, value_mm
        Time since the course began [s] and the signal relative to the reference [mm].
    exhales_mm
        Ends of exhale before and after each frame relative to the reference [mm], shape (2, n), found in the whole
        course without regard to causality; NaN outside the first and the last.
    is_breathing
        Whether the breath of each frame is at most twice as long as a usual one.
    bound_mm
        Largest drift that does not hold, of the breaths learned [mm].
    is_on, would_be_on
        Whether the beam is on, with the rules and without them.
    reasons
        Reason of the gate with the rules; None while the beam is on.
    """

    name: str
    time_s: FloatArray
    value_mm: FloatArray
    exhales_mm: FloatArray
    is_breathing: BoolArray
    bound_mm: float
    is_on: BoolArray
    would_be_on: BoolArray
    reasons: tuple[HoldReason | None, ...]

    @property
    def is_honest(self) -> BoolArray:
        """Whether the patient breathes and both neighbouring ends of exhale lie within the bound: none should hold."""
        return np.asarray((np.abs(self.exhales_mm) <= self.bound_mm).all(axis=0)) & self.is_breathing

    @property
    def is_elsewhere(self) -> BoolArray:
        """Whether both neighbouring ends of exhale lie beyond the bound."""
        return np.asarray((np.abs(self.exhales_mm) > self.bound_mm).all(axis=0))

    def is_held_by(self, reason: HoldReason) -> BoolArray:
        """Whether that rule took the beam, which would otherwise be on."""
        is_reason: BoolArray = np.array([one is reason for one in self.reasons], dtype=np.bool_)
        return self.would_be_on & ~self.is_on & is_reason


def gate_course(name: str, time_s: FloatArray, value_mm: FloatArray, edges: tuple[float, float]) -> GatedCourse | None:
    """Gate a course of a signal [mm] in a window in per cent of its learned range; None if it has too few breaths.

    Parameters
    ----------
    time_s, value_mm
        Increasing times [s] and values, shape (n,); inhale is positive. Resampled at 30 frames a second.
    """
    learned = learn_signal(time_s, value_mm, LEARN_S)
    if learned is None:
        return None
    low, high = learned.learned.low, learned.learned.high
    lower, upper = (low + 0.01 * edge * (high - low) for edge in edges)
    limits = GateLimits(
        window=AmplitudeWindow(lower=lower, upper=upper), operator_timeout_s=0.0, max_jump_mm=20.0, is_played=True
    )
    frames = list(learned.frames())
    is_on, reasons = gate_frames(limits, frames)
    would_be_on, _ = gate_frames(limits, frames, has_rules=False)
    seconds = np.arange(time_s[0], time_s[-1], 1.0 / FPS)
    levels = np.interp(seconds, time_s, value_mm) - learned.reference
    exhales_mm, lengths_s = _exhales_and_breaths(seconds, levels, learned.rise_mm)
    later = -len(learned.time_s)
    return GatedCourse(
        name=name,
        time_s=learned.time_s,
        value_mm=learned.value_mm,
        exhales_mm=exhales_mm[:, later:],
        is_breathing=lengths_s[later:] <= LONGEST_PERIODS * learned.period_s,
        bound_mm=min(limits.max_baseline_drift_mm, HALF * (upper - lower), BREATH_SHARE * learned.rise_mm),
        is_on=is_on,
        would_be_on=would_be_on,
        reasons=reasons,
    )


def gate_trace(path: Path, window: str) -> list[GatedCourse]:
    """Gate a recorded trace in one of `WINDOWS`; an empty list if it has too few breaths.

    Raises
    ------
    RecordingError
        The file cannot be read.
    """
    trace = read_trace(path)
    course = gate_course(path.name, trace.time_s, trace.motion_mm, WINDOWS[window])
    return [] if course is None else [course]


def _exhales_and_breaths(seconds: FloatArray, values: FloatArray, rise_mm: float) -> tuple[FloatArray, FloatArray]:
    """Return the ends of exhale before and after each time, shape (2, n), and the length of the breath [s], shape (n,).

    A breath lasts from one end of inhale to the next; NaN before the first and after the last.
    """
    smooth = gaussian_filter1d(values, SMOOTHING_S * FPS)
    lows, _ = find_peaks(-smooth, prominence=PROMINENCE_SHARE * rise_mm)
    highs, _ = find_peaks(smooth, prominence=PROMINENCE_SHARE * rise_mm)
    exhales, lengths_s = np.full((2, len(seconds)), np.nan), np.full(len(seconds), np.nan)
    for before, after in pairwise(lows):
        exhales[:, before:after] = smooth[[before, after], None]
    for before, after in pairwise(highs):
        lengths_s[before:after] = seconds[after] - seconds[before]
    return exhales, lengths_s


@dataclass(frozen=True, slots=True, kw_only=True)
class StoppedTrial:
    """Beam-on after the event began, with the rules and without: longest stay [s], and the largest drift with it [mm].

    ``drift_mm`` and ``free_drift_mm`` are None where the event is no drift.
    """

    kind: str
    on_s: float
    free_on_s: float
    drift_mm: float | None = None
    free_drift_mm: float | None = None


def stopped_trials(volunteers: Iterable[int] = VOLUNTEERS, seed: int = FIRST_SEED) -> Iterator[StoppedTrial]:
    """Yield every trial of every volunteer; raise InvalidValueError for a volunteer that does not exist."""
    for volunteer in volunteers:
        yield from _ceased(volunteer, seed)
        for rate_mm_s in DRIFTS_MM_S:
            for sign in (1.0, -1.0):
                yield from _drifted(volunteer, seed, sign * rate_mm_s)


def _ceased(volunteer: int, seed: int) -> Iterator[StoppedTrial]:
    apnoea = make_trial(volunteer, seed, ("apnoea",), SECONDS)
    episode = apnoea.episodes[0]
    course = gate_course("apnoea", apnoea.time_s, apnoea.value_mm, EXHALE)
    if course is not None:
        yield _longest("apnoea", course, (course.time_s >= episode.start_s) & (course.time_s <= episode.end_s))
    calm = make_trial(volunteer, seed, (), SECONDS)
    for kind, edges, is_low in (
        ("breath held at the end of exhale", EXHALE, True),
        ("breath held at the end of inhale, inhale window", INHALE, False),
    ):
        yield from _stopped(kind, calm.time_s, _held(calm.time_s, calm.value_mm, is_low=is_low, slide_mm_s=0.0), edges)
    for way, slide_mm_s in (("up", SLIDE_MM_S), ("down", -SLIDE_MM_S)):
        values = _held(calm.time_s, calm.value_mm, is_low=True, slide_mm_s=slide_mm_s)
        yield from _stopped(f"no breath, sliding {way}", calm.time_s, values, EXHALE)


def _held(seconds: FloatArray, values: FloatArray, *, is_low: bool, slide_mm_s: float) -> FloatArray:
    """Return the course standing still, or sliding, from its first end of exhale or inhale after 45 s."""
    period = (seconds >= STOPS_S) & (seconds < STOPS_S + 6.0)
    chosen = values[period]
    at = int(np.flatnonzero(period)[0] + (np.argmin(chosen) if is_low else np.argmax(chosen)))
    held = values.copy()
    held[at:] = values[at] + slide_mm_s * (seconds[at:] - seconds[at])
    return held


def _stopped(kind: str, seconds: FloatArray, values: FloatArray, edges: tuple[float, float]) -> Iterator[StoppedTrial]:
    course = gate_course(kind, seconds, values, edges)
    if course is not None:
        yield _longest(kind, course, course.time_s >= STOPS_S)


def _longest(kind: str, course: GatedCourse, during: BoolArray) -> StoppedTrial:
    on_s, free_on_s = (_longest_s(flags & during) for flags in (course.is_on, course.would_be_on))
    return StoppedTrial(kind=kind, on_s=on_s, free_on_s=free_on_s)


def _longest_s(flags: BoolArray) -> float:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return float((edges[1::2] - edges[::2]).max(initial=0)) / FPS


def _drifted(volunteer: int, seed: int, rate_mm_s: float) -> Iterator[StoppedTrial]:
    trial = make_trial(volunteer, seed, ("drift",), SECONDS, drift_mm_s=rate_mm_s)
    episode = trial.episodes[0]
    course = gate_course("drift", trial.time_s, trial.value_mm, EXHALE)
    if course is None:
        return
    drift_mm = abs(rate_mm_s) * np.clip(course.time_s - episode.start_s, 0.0, episode.end_s - episode.start_s)
    during = course.time_s >= episode.start_s
    found = _longest(f"drift of {rate_mm_s:+g} mm/s", course, during)
    yield StoppedTrial(
        kind=found.kind,
        on_s=found.on_s,
        free_on_s=found.free_on_s,
        drift_mm=float(drift_mm[course.is_on & during].max(initial=0.0)),
        free_drift_mm=float(drift_mm[course.would_be_on & during].max(initial=0.0)),
    )
