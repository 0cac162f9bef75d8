"""Drive the light through the beam line's output, and note when each change was commanded and read back.

The output is the permit: the line permits the beam whenever the light is on. Every permit is a short lease that is
renewed while the light is to stay on, so that it goes off by itself if this process ends.

The light's changes: pseudo-random intervals, and what is known of the time of each change.

The intervals are spread evenly and continuously over a range of several frames, so that the changes fall at every
phase of the frame period, and no other delay than the true one makes the pattern agree with the pictures.
"""

import random
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np

from engine.beam.commissioning import POLL_NS, Pulser
from engine.beam.line import BeamLine
from engine.core.clock import NS_PER_MS, NS_PER_S, Clock
from engine.core.errors import BeamLineError, TidegateError
from engine.core.frames import FloatArray
from engine.core.gate_state import HoldReason

SHORTEST_NS, LONGEST_NS = 150 * NS_PER_MS, 450 * NS_PER_MS
FEWEST_CHANGES = 40
"""Fewest changes in each direction."""
MIN_SPREAD = 0.1
"""Least standard deviation of the intervals, as a share of their mean."""
MAX_KNOWN_NS = 100 * NS_PER_MS
LEASE_MS = 200.0
RENEW_NS = 50 * NS_PER_MS
JOIN_S = 3.0


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


class Light(Protocol):
    """A light whose changes are known."""

    @property
    def changes(self) -> Sequence[LightChange]:
        """The changes so far, in order."""

    @property
    def failure(self) -> str:
        """Why the light could not be driven to its end; empty otherwise."""

    def driving(self) -> AbstractContextManager[None]:
        """Run the pattern while the block runs."""


class BeamLineLight:
    """A light on the output of a beam line, driven by a thread of its own.

    Parameters
    ----------
    intervals_ns
        Lengths of its phases [ns], off first.
    """

    def __init__(
        self, line: BeamLine, clock: Clock, wait_ns: Callable[[int], None], intervals_ns: Sequence[int]
    ) -> None:
        self._line, self._clock, self._wait_ns = line, clock, wait_ns
        self._intervals_ns = tuple(intervals_ns)
        self._pulser = Pulser(line, clock, pulse_ms=LEASE_MS, wait_ns=wait_ns)
        self._is_ended = False
        self._granted_ns = 0
        self.changes: list[LightChange] = []
        self.failure = ""

    @contextmanager
    def driving(self) -> Iterator[None]:
        """Open and arm the line, run the pattern in a thread, then hold and close the line on every way out."""
        thread = threading.Thread(target=self._run_guarded, name="qa-light", daemon=True)
        try:
            self._line.open()
            self._pulser.arm()
            thread.start()
            yield
        finally:
            self._is_ended = True
            self._line.hold(HoldReason.ENGINE_STOPPED)  # latches: a permit of the thread is refused from here on
            if thread.ident is not None:
                thread.join(JOIN_S)
            self._line.hold(HoldReason.ENGINE_STOPPED)
            self._line.close()

    def run(self) -> None:
        """Run the whole pattern in the calling thread; raise BeamLineError if the line fails."""
        try:
            next_ns = self._clock.now_ns()
            for number, length_ns in enumerate(self._intervals_ns):
                next_ns += length_ns
                is_on = number % 2 == 0
                self._keep(next_ns, is_on=not is_on)
                if self._is_ended:
                    return
                self._change(is_on=is_on)
        finally:
            self._line.hold(HoldReason.OPERATOR_HOLD)

    def _run_guarded(self) -> None:
        try:
            self.run()
        except TidegateError as error:
            if not self._is_ended:
                self.failure = str(error)

    def _keep(self, until_ns: int, *, is_on: bool) -> None:
        """Wait until a time; renew the lease meanwhile, and raise BeamLineError where one may have lapsed."""
        while not self._is_ended and (now_ns := self._clock.now_ns()) < until_ns:
            if is_on:
                self._renew(now_ns)
            self._wait_ns(min(until_ns - now_ns, RENEW_NS))

    def _renew(self, now_ns: int) -> None:
        self._pulser.renew()
        self._refuse_lapsed()
        self._granted_ns = now_ns

    def _refuse_lapsed(self) -> None:
        """Raise BeamLineError where the lease may have ended before now: the light then went off at an unknown time."""
        if self._clock.now_ns() - self._granted_ns >= LEASE_MS * NS_PER_MS:
            msg = "the light's lease was renewed too late: the machine is too busy for this measurement"
            raise BeamLineError(msg)

    def _change(self, *, is_on: bool) -> None:
        commanded_ns = self._clock.now_ns()
        if is_on:
            self._granted_ns = commanded_ns
            self._pulser.permit()
        else:
            self._pulser.hold()
            self._refuse_lapsed()
            self._pulser.await_off(commanded_ns)
        self.changes.append(LightChange(is_on=is_on, earliest_ns=commanded_ns, latest_ns=self._clock.now_ns()))
        self._wait_ns(POLL_NS)  # the line refuses a permit with the same time stamp as a hold
