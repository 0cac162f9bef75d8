"""Made courses in which a rule on breathing has to end the beam: ceased breathing, pictures that stand still, drift."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from engine.core.frames import BoolArray, FloatArray
from engine.lab.evaluation.breathing.bench import DRIFTS_MM_S, FIRST_SEED
from engine.lab.evaluation.breathing.trials import make_trial
from engine.lab.evaluation.gating.breathing_rules import EXHALE, FPS, GatedCourse, gate_course

INHALE = (60.0, 180.0)
SECONDS = 80.0
STOPS_S = 45.0
SLIDE_MM_S = 0.7
VOLUNTEERS = (1, 3, 5, 7, 9)
TRIALS_EACH = 5 + 2 * len(DRIFTS_MM_S)


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
