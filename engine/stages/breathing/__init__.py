"""Breathing: what a piece of signal says of it, and an online monitor that follows one signal frame by frame."""

from engine.stages.breathing.cycles import count_cycles, excursion_mm, noise_mm, smoothed, speed_mm_s
from engine.stages.breathing.monitor import (
    BreathingState,
    correct_baseline,
    follow_breathing,
    lose_breathing,
    shifted,
    start_breathing,
    with_baseline,
)

__all__ = [
    "BreathingState",
    "correct_baseline",
    "count_cycles",
    "excursion_mm",
    "follow_breathing",
    "lose_breathing",
    "noise_mm",
    "shifted",
    "smoothed",
    "speed_mm_s",
    "start_breathing",
    "with_baseline",
]
