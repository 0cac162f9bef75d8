"""The light's changes: pseudo-random intervals, and what is known of the time of each change.

The intervals are spread evenly and continuously over a range of several frames, so that the changes fall at every
phase of the frame period, and no other delay than the true one makes the pattern agree with the pictures.
"""

import random
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from engine.core.clock import NS_PER_MS, NS_PER_S
from engine.core.frames import FloatArray

SHORTEST_NS, LONGEST_NS = 150 * NS_PER_MS, 450 * NS_PER_MS
FEWEST_CHANGES = 40
"""Fewest changes in each direction."""
MIN_SPREAD = 0.1
"""Least standard deviation of the intervals, as a share of their mean."""
MAX_KNOWN_NS = 100 * NS_PER_MS


@dataclass(frozen=True, slots=True, kw_only=True)
class LightChange:
    """A change of the light; it happened between the two times [ns, host monotonic]."""

    is_on: bool
    earliest_ns: int
    latest_ns: int


def intervals_ns(seed: int, seconds: float) -> tuple[int, ...]:
    """Return the lengths of the light's phases [ns], off first, together no longer than ``seconds``.

    Their number is even, so that the last change is to off, as the output is left.
    """
    chance = random.Random(seed)  # noqa: S311 - a schedule, no secret
    lengths: list[int] = []
    left_ns = int(seconds * NS_PER_S)
    while (length_ns := chance.randint(SHORTEST_NS, LONGEST_NS)) <= left_ns:
        lengths.append(length_ns)
        left_ns -= length_ns
    return tuple(lengths[: len(lengths) // 2 * 2])


def refuse_pattern(changes: Sequence[LightChange]) -> str | None:
    """Return why a pattern cannot be used; None where it can."""
    fewest = min(sum(change.is_on for change in changes), sum(not change.is_on for change in changes))
    if fewest < FEWEST_CHANGES:
        return f"the light changed {fewest} times in one direction: at least {FEWEST_CHANGES} are needed"
    if any(change.is_on is after.is_on for change, after in pairwise(changes)):
        return "the light's changes do not alternate"
    return _refuse_times(changes)


def _refuse_times(changes: Sequence[LightChange]) -> str | None:
    at_ns = np.array([change.earliest_ns for change in changes], dtype=np.int64)
    known_ns = np.array([change.latest_ns - change.earliest_ns for change in changes], dtype=np.int64)
    steps_ns = np.diff(at_ns)
    if (steps_ns <= 0).any() or (known_ns < 0).any():
        return "the times of the light's changes do not increase"
    if known_ns.max() > MAX_KNOWN_NS:
        return (
            f"a change of the light is known to {known_ns.max() / NS_PER_MS:.0f} ms only: at most "
            f"{MAX_KNOWN_NS // NS_PER_MS} ms are allowed; the output answers too slowly"
        )
    if steps_ns.min() < SHORTEST_NS // 2:
        return f"the light changed twice within {steps_ns.min() / NS_PER_MS:.0f} ms, which a camera may not see"
    if float(np.std(steps_ns)) < MIN_SPREAD * float(np.mean(steps_ns)):
        return "the light's intervals are nearly equal, so that several delays would agree with the pictures"
    return None


def level_at(changes: Sequence[LightChange], at_ns: FloatArray) -> FloatArray:
    """Return the light's level, 0 or 1, at host times [ns], same shape; 0 before the first change."""
    middle_ns = np.array([0.5 * (change.earliest_ns + change.latest_ns) for change in changes])
    levels = np.array([0.0, *(1.0 if change.is_on else 0.0 for change in changes)])
    found: FloatArray = levels[np.searchsorted(middle_ns, at_ns, side="right")]
    return found
