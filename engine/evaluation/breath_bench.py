"""The bench of the breathing monitor: which signals are made, followed and judged, in as many processes as are given.

What the monitor was tuned on were seeds below 100; the bench begins at 100, so that it reports on others.
"""

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np

from engine.errors import InvalidValueError, RecordingError
from engine.evaluation.breath_scores import Finding, false_alarms, find, phase_errors
from engine.evaluation.breath_trials import DRIFT_S, EVENT_S, LEARN_S, Span, listen, make_trial
from engine.frames import FloatArray
from engine.phantom.builds import BUILDS

FIRST_SEED = 100
KINDS = ("cough", "sigh", "apnoea", "talking", "irregular")
DRIFTS_MM_S = (0.1, 0.2, 0.4, 0.74)
REGULAR_S = 1200.0
MAX_SEEDS = 100
MAX_HOURS = 100.0
MAX_JOBS = 64
PHASE_STEP = 10
"""One error of the phase in so many is kept: neighbours say the same."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One signal to follow: an episode of a kind, a drift of a rate, or regular breathing."""

    group: str
    volunteer: int
    seed: int
    seconds: float
    kinds: tuple[str, ...] = ()
    drift_mm_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Judged:
    """What came of a job; errors of the phase [%] and of the rate [1/min]."""

    job: Job
    findings: tuple[Finding, ...]
    false_alarms: tuple[Span, ...]
    phase_errors: FloatArray
    phase_share: float
    rate_error_per_min: float


def check_plan(seeds: int, hours: float, jobs: int) -> None:
    """Refuse numbers out of their bounds."""
    if not 0 <= seeds <= MAX_SEEDS:
        raise InvalidValueError("seeds", seeds, f"from 0 to {MAX_SEEDS}")
    if not 0.0 <= hours <= MAX_HOURS:
        raise InvalidValueError("hours", hours, f"from 0 to {MAX_HOURS:g}")
    if not 1 <= jobs <= MAX_JOBS:
        raise InvalidValueError("jobs", jobs, f"from 1 to {MAX_JOBS}")


def plan(seeds: int, hours: float) -> list[Job]:
    """Return the signals: each kind and each drift for every volunteer, and hours of regular breathing in all."""
    made = []
    for volunteer in range(1, len(BUILDS) + 1):
        for seed in range(FIRST_SEED, FIRST_SEED + seeds):
            made += [
                Job(group=kind, volunteer=volunteer, seed=seed, seconds=LEARN_S + EVENT_S, kinds=(kind,))
                for kind in KINDS
            ]
            # Up where the seed is even, down where it is odd.
            sign = 1.0 if seed % 2 == 0 else -1.0
            made += [
                Job(
                    group=f"drift {rate:g}",
                    volunteer=volunteer,
                    seed=seed,
                    seconds=LEARN_S + DRIFT_S,
                    kinds=("drift",),
                    drift_mm_s=sign * rate,
                )
                for rate in DRIFTS_MM_S
            ]
    lengths = round(hours * 3600.0 / REGULAR_S)
    made += [
        Job(group="regular", volunteer=1 + number % len(BUILDS), seed=FIRST_SEED + number, seconds=REGULAR_S)
        for number in range(lengths)
    ]
    return made


def judge(job: Job) -> Judged:
    """Make a signal, follow it and judge what was said."""
    trial = make_trial(job.volunteer, job.seed, job.kinds, job.seconds, drift_mm_s=job.drift_mm_s)
    told = listen(trial.time_s, trial.value_mm)
    learned = trial.time_s > LEARN_S
    rate_error = np.abs(told.rate_per_min[learned] - 60.0 / trial.period_s)
    return Judged(
        job=job,
        findings=tuple(find(trial, told)),
        false_alarms=tuple(false_alarms(trial, told)),
        phase_errors=phase_errors(trial, told)[::PHASE_STEP],
        phase_share=float(np.isfinite(told.phase_percent[learned]).mean()),
        rate_error_per_min=float(np.nanmean(rate_error)) if np.isfinite(rate_error).any() else float("nan"),
    )


def run(planned: list[Job], jobs: int, on_done: Callable[[int], object]) -> list[Judged]:
    """Judge them all, in the plan's order; ``on_done`` is told how many there are so far.

    Raises
    ------
    RecordingError
        A process was killed.
    """
    try:
        pairs = sorted(_judged(planned, jobs, on_done), key=lambda pair: pair[0])
    except BrokenProcessPool as error:
        raise RecordingError("a process of the bench was killed; is there memory enough?") from error
    return [judged for _, judged in pairs]


def _judged(planned: list[Job], jobs: int, on_done: Callable[[int], object]) -> Iterator[tuple[int, Judged]]:
    if jobs == 1:
        for number, job in enumerate(planned):
            yield number, judge(job)
            on_done(number + 1)
        return
    with ProcessPoolExecutor(max_workers=jobs, mp_context=get_context("spawn"), initializer=_end_quietly) as pool:
        numbers = {pool.submit(judge, job): number for number, job in enumerate(planned)}
        try:
            for done, future in enumerate(as_completed(numbers), start=1):
                yield numbers[future], future.result()
                on_done(done)
        finally:
            for future in numbers:
                future.cancel()


def _end_quietly() -> None:
    """Let Ctrl-C end a worker at once: the command itself says that it stopped."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
