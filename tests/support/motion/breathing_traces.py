"""Breathing built by construction, and a monitor that follows it."""

import numpy as np

from engine.core.breath import WHOLE
from engine.motion.breathing import follow_breathing, start_breathing

FPS = 30.0


def times(seconds, fps=FPS):
    return np.arange(round(seconds * fps)) / fps


def breath(phase):
    """One breath against its phase from the end of inhale, 0 to 1: quick in, slow out, a rest between."""
    from_start = (np.asarray(phase) + 0.4) % 1.0
    warped = np.interp(from_start, [0.0, 0.4, 1.0], [0.0, 0.5, 1.0])
    return np.sin(np.pi * warped) ** 4


def regular(seconds, *, amplitude=10.0, period=4.0, fps=FPS, noise=0.1, heart=0.15, seed=0):
    """Regular breathing as a camera sees it [mm], and its true phase [%]."""
    at = times(seconds, fps)
    phase = (at / period) % 1.0
    value = amplitude * breath(phase) + np.random.default_rng(seed).normal(0.0, noise, len(at))
    return at, value + heart * np.sin(2.0 * np.pi * 1.1 * at), 100.0 * phase


def follow(at, value, choice=WHOLE, state=None):
    """Feed a monitor; return the breath after every value."""
    state = start_breathing(choice) if state is None else state
    reported = []
    for seconds, one in zip(np.asarray(at).tolist(), np.asarray(value).tolist(), strict=True):
        state = follow_breathing(state, seconds, one)
        reported.append(state.breath)
    return reported


def kinds(breath):
    return {event.kind.value for event in breath.events}


def onsets(reported, at):
    """When each event began to be reported: (kind, seconds)."""
    found, before = [], set()
    for seconds, one in zip(at, reported, strict=True):
        now = kinds(one)
        found += [(kind, float(seconds)) for kind in sorted(now - before)]
        before = now
    return found
