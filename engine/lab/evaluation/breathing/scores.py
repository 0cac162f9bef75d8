"""Scores the monitor's output on signals with known episodes and phases."""

from dataclasses import dataclass

import numpy as np

from engine.core.frames import FloatArray
from engine.lab.evaluation.breathing.trials import MonitorOutput, Span, Trial, true_phase

LATE_S = 3.0
"""Latest start of an event after its label's end that still counts as found [s]."""
AFTER_S = 20.0
"""Time after a label in which an event is no false alarm, because the breath was disturbed [s]."""
CONFIDENCE_Z = 1.96


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
