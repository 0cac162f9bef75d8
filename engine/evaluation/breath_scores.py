"""Judges what the monitor said of breathing of which everything is known."""

from dataclasses import dataclass

import numpy as np

from engine.evaluation.breath_trials import Span, Told, Trial, true_phase
from engine.frames import FloatArray

LATE_S = 3.0
"""An event told so long after its label's end still counts as found [s]."""
AFTER_S = 20.0
"""What is told so soon after a label, or in it, is no false alarm: the breath has been disturbed [s]."""
CONFIDENCE_Z = 1.96


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Whether a labelled episode was found, and how long after its beginning [s]; None when it was not."""

    kind: str
    delay_s: float | None
    cycles: float | None


def find(trial: Trial, told: Told) -> list[Finding]:
    """Look each labelled episode up in what was told."""
    findings = []
    for episode in trial.episodes:
        starts = [
            span.start_s
            for span in told.spans
            if span.kind.value == episode.kind
            and span.end_s >= episode.start_s
            and span.start_s <= episode.end_s + LATE_S
        ]
        delay_s = max(0.0, min(starts) - episode.start_s) if starts else None
        cycles = None if delay_s is None else delay_s / trial.period_s
        findings.append(Finding(kind=episode.kind, delay_s=delay_s, cycles=cycles))
    return findings


def false_alarms(trial: Trial, told: Told) -> list[Span]:
    """Return what was told where nothing was."""
    return [
        span
        for span in told.spans
        if not any(episode.start_s <= span.start_s <= episode.end_s + AFTER_S for episode in trial.episodes)
    ]


def phase_errors(trial: Trial, told: Told) -> FloatArray:
    """Error of every phase that was told [%], signed, within half a breath."""
    error = told.phase_percent - true_phase(trial)
    return np.asarray((error[np.isfinite(error)] + 50.0) % 100.0 - 50.0)


def wilson(found: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a share, after Wilson (1927, doi:10.1080/01621459.1927.10502953)."""
    if count == 0:
        return 0.0, 1.0
    share, z2 = found / count, CONFIDENCE_Z**2
    middle = share + z2 / (2 * count)
    reach = CONFIDENCE_Z * np.sqrt(share * (1.0 - share) / count + z2 / (4 * count * count))
    scale = 1.0 + z2 / count
    return float(max(0.0, (middle - reach) / scale)), float(min(1.0, (middle + reach) / scale))
