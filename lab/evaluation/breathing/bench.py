"""Evaluation of the breathing monitor: plan, generation, monitoring and scoring of signals in several processes.

The monitor was tuned on seeds below 100; the evaluation starts at 100, so that its signals are independent.

Scores the monitor's output on signals with known episodes and phases.
"""

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np

from engine.core.bounds import check_number, check_whole_number
from engine.core.errors import RecordingError
from engine.core.frames import FloatArray
from engine.core.native_process import end_with_the_pool
from lab.evaluation.breathing.trials import (
    DRIFT_S,
    EVENT_S,
    LEARN_S,
    MonitorOutput,
    Span,
    Trial,
    make_trial,
    run_monitor,
    true_phase,
)
from lab.phantom.builds import BUILDS

LATE_S = 3.0
"""Latest start of an event after its label's end that still counts as found [s]."""
AFTER_S = 20.0
"""Time after a label in which an event is no false alarm, because the breath was disturbed [s]."""
CONFIDENCE_Z = 1.96
FIRST_SEED = 100
KINDS = ("cough", "sigh", "apnoea", "talking", "irregular")
DRIFTS_MM_S = (0.1, 0.2, 0.4, 0.74)
REGULAR_S = 1200.0
MAX_SEEDS = 100
MAX_HOURS = 100.0
MAX_JOBS = 64
PHASE_STEP = 10
"""Every how many samples a phase error is stored: neighbouring errors are nearly equal."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Delay of a labelled episode's detection after its start [s, and in breathing cycles]; None if it was missed."""

    kind: str
    delay_s: float | None
    cycles: float | None


def match_episodes(trial: Trial, output: MonitorOutput) -> list[Finding]:
    """Match each labelled episode with the monitor's events of its kind."""
    findings = []
    for episode in trial.episodes:
        starts = [
            span.start_s
            for span in output.spans
            if span.kind.value == episode.kind
            and span.end_s >= episode.start_s
            and span.start_s <= episode.end_s + LATE_S
        ]
        delay_s = max(0.0, min(starts) - episode.start_s) if starts else None
        cycles = None if delay_s is None else delay_s / trial.period_s
        findings.append(Finding(kind=episode.kind, delay_s=delay_s, cycles=cycles))
    return findings


def false_alarms(trial: Trial, output: MonitorOutput) -> list[Span]:
    """Return the events that no labelled episode explains."""
    return [
        span
        for span in output.spans
        if not any(episode.start_s <= span.start_s <= episode.end_s + AFTER_S for episode in trial.episodes)
    ]


def phase_errors(trial: Trial, output: MonitorOutput) -> FloatArray:
    """Error of every phase of the monitor [%], signed, from -50 to 50."""
    error = output.phase_percent - true_phase(trial)
    return np.asarray((error[np.isfinite(error)] + 50.0) % 100.0 - 50.0)


def wilson(found: int, count: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a share (Wilson 1927, doi:10.1080/01621459.1927.10502953)."""
    if count == 0:
        return 0.0, 1.0
    share, z2 = found / count, CONFIDENCE_Z**2
    middle = share + z2 / (2 * count)
    reach = CONFIDENCE_Z * np.sqrt(share * (1.0 - share) / count + z2 / (4 * count * count))
    scale = 1.0 + z2 / count
    return float(max(0.0, (middle - reach) / scale)), float(min(1.0, (middle + reach) / scale))


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One signal to evaluate: an episode of a kind, a drift of a rate [mm/s], or regular breathing."""

    group: str
    volunteer: int
    seed: int
    seconds: float
    kinds: tuple[str, ...] = ()
    drift_mm_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScoredSignal:
    """Scores of a job; errors of the phase [%] and of the rate [1/min]."""

    job: Job
    findings: tuple[Finding, ...]
    false_alarms: tuple[Span, ...]
    phase_errors: FloatArray
    phase_share: float
    rate_error_per_min: float


def check_plan(seeds: int, hours: float, jobs: int) -> None:
    """Raise InvalidValueError naming the first number out of bounds."""
    check_whole_number("seeds", seeds, 0, MAX_SEEDS)
    check_number("hours", hours, 0.0, MAX_HOURS)
    check_whole_number("jobs", jobs, 1, MAX_JOBS)


def plan(seeds: int, hours: float) -> list[Job]:
    """Return the jobs: each kind and drift per volunteer and seed, and ``hours`` of regular breathing in total."""
    made = []
    for volunteer in range(1, len(BUILDS) + 1):
        for seed in range(FIRST_SEED, FIRST_SEED + seeds):
            made += [
                Job(group=kind, volunteer=volunteer, seed=seed, seconds=LEARN_S + EVENT_S, kinds=(kind,))
                for kind in KINDS
            ]
            # Upwards for even seeds, downwards for odd ones.
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


def score_job(job: Job) -> ScoredSignal:
    """Generate a signal, run the monitor on it and score its output."""
    trial = make_trial(job.volunteer, job.seed, job.kinds, job.seconds, drift_mm_s=job.drift_mm_s)
    output = run_monitor(trial.time_s, trial.value_mm)
    learned = trial.time_s > LEARN_S
    rate_error = np.abs(output.rate_per_min[learned] - 60.0 / trial.period_s)
    return ScoredSignal(
        job=job,
        findings=tuple(match_episodes(trial, output)),
        false_alarms=tuple(false_alarms(trial, output)),
        phase_errors=phase_errors(trial, output)[::PHASE_STEP],
        phase_share=float(np.isfinite(output.phase_percent[learned]).mean()),
        rate_error_per_min=float(np.nanmean(rate_error)) if np.isfinite(rate_error).any() else float("nan"),
    )


def run(planned: list[Job], jobs: int, on_done: Callable[[int], object]) -> list[ScoredSignal]:
    """Score all jobs, in the plan's order; ``on_done`` is called with the number done so far.

    Raises
    ------
    RecordingError
        A process was killed.
    """
    try:
        pairs = sorted(_scored(planned, jobs, on_done), key=lambda pair: pair[0])
    except BrokenProcessPool as error:
        raise RecordingError("a process of the evaluation was killed; is there enough memory?") from error
    return [scored for _, scored in pairs]


def _scored(planned: list[Job], jobs: int, on_done: Callable[[int], object]) -> Iterator[tuple[int, ScoredSignal]]:
    if jobs == 1:
        for number, job in enumerate(planned):
            yield number, score_job(job)
            on_done(number + 1)
        return
    with ProcessPoolExecutor(max_workers=jobs, mp_context=get_context("spawn"), initializer=_end_quietly) as pool:
        numbers = {pool.submit(score_job, job): number for number, job in enumerate(planned)}
        try:
            for done, future in enumerate(as_completed(numbers), start=1):
                yield numbers[future], future.result()
                on_done(done)
        finally:
            for future in numbers:
                future.cancel()


def _end_quietly() -> None:
    """Let Ctrl-C end a worker at once, as the command reports it, and the command's own end at any time."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    end_with_the_pool()
