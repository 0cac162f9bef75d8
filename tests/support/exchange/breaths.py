"""Breaths whose places are known."""

import numpy as np

RATE, PERIOD_S = 30.0, 4.0


def breath(seconds=40.0, period_s=PERIOD_S, depth_mm=8.0, noise_mm=0.0, drift_mm_s=0.0):
    """Motion whose ends of inhale lie at whole periods."""
    at = np.arange(0.0, seconds, 1.0 / RATE)
    motion = depth_mm / 2.0 * (1.0 + np.cos(2.0 * np.pi * at / period_s)) + drift_mm_s * at
    return at, motion + noise_mm * np.random.default_rng(1).standard_normal(len(at))
