"""Simulated breathing signals with known episodes and phases, and the monitor's output on them.

The signal is the whole region's motion: the mean of a virtual volunteer's abdomen and chest, with the noise, heartbeat
and jitter of frame times of measured signals.
"""

from dataclasses import dataclass

import numpy as np

from engine.core.breath import WHOLE, BreathEventKind
from engine.core.frames import BoolArray, FloatArray
from engine.motion.breathing import follow_breathing, start_breathing
from lab.phantom.breathing import time_grid
from lab.phantom.builds import find_build
from lab.phantom.episodes import Episode, lay_out_course

FPS = 30.0
NOISE_MM = (0.05, 0.12)
HEART_MM = (0.05, 0.2)
HEART_HZ = (0.95, 1.35)
JITTER_S = 0.002
LEARN_S = 28.0
EVENT_S = 80.0
DRIFT_S = 64.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trial:
    """A signal [mm] at ``time_s``, its labelled episodes, and the true times of end of inhale [s]."""

    name: str
    period_s: float
    time_s: FloatArray
    value_mm: FloatArray
    episodes: tuple[Episode, ...]
    peaks_s: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """An event of the monitor: start and end [s of the signal], and its highest confidence, 0 to 1."""

    kind: BreathEventKind
    start_s: float
    end_s: float
    confidence: float
    detail: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MonitorOutput:
    """The monitor's output per sample, shape (n,), NaN where it gives no value; and its events."""

    phase_percent: FloatArray
    phase_confidence: FloatArray
    rate_per_min: FloatArray
    baseline_mm: FloatArray
    spans: tuple[Span, ...]

    def during(self, kind: BreathEventKind, time_s: FloatArray) -> BoolArray:
        """Whether an event of that kind is active at each time, shape (n,)."""
        found = np.zeros(len(time_s), dtype=bool)
        for span in self.spans:
            if span.kind is kind:
                found |= (time_s >= span.start_s) & (time_s <= span.end_s)
        return found


def make_trial(
    volunteer: int, seed: int, kinds: tuple[str, ...], seconds: float, *, drift_mm_s: float | None = None
) -> Trial:
    """Generate a signal; ``kinds`` are the episodes in order, none for regular breathing."""
    rng = np.random.default_rng([seed, volunteer, len(kinds), round(1000.0 * (drift_mm_s or 0.0)) % 9973])
    build = find_build(volunteer)
    grid = time_grid(seconds)
    course = lay_out_course(build, grid, seconds, rng, kinds=kinds, quiet_s=LEARN_S, drift_mm_s=drift_mm_s)
    time_s = np.arange(0.0, seconds, 1.0 / FPS)
    time_s += rng.uniform(-JITTER_S, JITTER_S, len(time_s)) + JITTER_S
    motion = 0.5 * (course.signals.abdomen_mm + course.signals.thorax_mm)
    heart = rng.uniform(*HEART_MM) * np.sin(2.0 * np.pi * rng.uniform(*HEART_HZ) * time_s)
    noise = rng.normal(0.0, rng.uniform(*NOISE_MM), len(time_s))
    return Trial(
        name=f"volunteer {volunteer}, seed {seed}",
        period_s=build.period_s,
        time_s=time_s,
        value_mm=np.interp(time_s, grid, motion) + heart + noise,
        episodes=course.episodes,
        peaks_s=course.peaks_s,
    )


def run_monitor(time_s: FloatArray, value_mm: FloatArray) -> MonitorOutput:
    """Run the monitor over a signal, arrays of shape (n,)."""
    state = start_breathing(WHOLE)
    figures = np.full((len(time_s), 4), np.nan)
    spans: list[Span] = []
    active_spans: dict[BreathEventKind, Span] = {}
    for index, (now_s, value) in enumerate(zip(time_s.tolist(), value_mm.tolist(), strict=True)):
        state = follow_breathing(state, now_s, value)
        breath = state.breath
        phase, confidence = breath.phase_percent, breath.phase_confidence
        output = (phase, None if phase is None else confidence, breath.rate_per_min, breath.baseline)
        figures[index] = [np.nan if figure is None else figure for figure in output]
        present = {event.kind: event for event in breath.events}
        spans += [active_spans.pop(kind) for kind in list(active_spans) if kind not in present]
        for kind, event in present.items():
            start_s = active_spans[kind].start_s if kind in active_spans else now_s
            active_spans[kind] = Span(
                kind=kind, start_s=start_s, end_s=now_s, confidence=event.confidence, detail=event.detail
            )
    ordered = sorted([*spans, *active_spans.values()], key=lambda span: span.start_s)
    return MonitorOutput(
        phase_percent=figures[:, 0],
        phase_confidence=figures[:, 1],
        rate_per_min=figures[:, 2],
        baseline_mm=figures[:, 3],
        spans=tuple(ordered),
    )


def true_phase(trial: Trial) -> FloatArray:
    """Phase [%] from the true times of end of inhale, linear between them; NaN outside of them."""
    phase = np.interp(trial.time_s, trial.peaks_s, 100.0 * np.arange(len(trial.peaks_s)))
    outside = (trial.time_s < trial.peaks_s[0]) | (trial.time_s > trial.peaks_s[-1])
    return np.where(outside, np.nan, phase % 100.0)
