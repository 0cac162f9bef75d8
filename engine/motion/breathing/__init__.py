"""Breathing analysis: statistics of a recorded signal, and an online monitor of one signal."""

from engine.motion.breathing.cycles import count_cycles, excursion_mm, noise_mm, smoothed, speed_mm_s
from engine.motion.breathing.monitor import (
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
