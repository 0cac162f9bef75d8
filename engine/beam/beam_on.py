"""The accelerator's beam-on signal compared with the permit, in both directions.

A beam without a permit is a fault. A permit without a beam is reported and holds nothing: the accelerator may be
waiting for a person. The time from the end of each permit to the beam off is measured.

Pure: the caller passes times and readings. `engine.beam.compared_line` is the line that uses it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

from engine.core.bounds import check_number
from engine.core.clock import NS_PER_MS

AFTER_PERMIT_BOUNDS_MS = (20.0, 1000.0)
AFTER_PERMIT_MS = 250.0
"""Default of the longest time that the beam may be on after its permit has ended."""

ABSENT_NS = 1000 * NS_PER_MS
"""Time of a permit without a beam after which it is reported."""

ReadBeamOn: TypeAlias = Callable[[], bool | None]
"""Newest reading of the accelerator's signal, any thread, without waiting; None where it is not known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamOnState:
    """What the comparison knows; for display.

    Attributes
    ----------
    is_on
        Newest reading; None where it is not known.
    is_absent
        Whether a permit has lasted for `ABSENT_NS` without a beam.
    absences
        Number of times that this began.
    last_off_ms, slowest_off_ms
        Time from the end of a permit to the beam off, of the last hold and of the slowest [ms]; None before the first.
    offs
        Number of holds of which it was measured.
    violation
        Why the beam is on without a permit; None where it is not.
    """

    is_on: bool | None = None
    is_absent: bool = False
    absences: int = 0
    last_off_ms: float | None = None
    slowest_off_ms: float | None = None
    offs: int = 0
    violation: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Permission:
    """The permit as of now: since when it has stood, or when the last one ended; both None before the first [ns]."""

    since_ns: int | None = None
    ended_ns: int | None = None


class BeamOnComparison:
    """Compares one reading after the other; owned by one thread, ``state`` and ``violation`` are read by any.

    Attributes
    ----------
    state
        As of the newest reading.
    violation
        Why the beam is on without a permit, a sentence that stays the same while that lasts; None where it is not.
    """

    def __init__(self, *, after_permit_ms: float = AFTER_PERMIT_MS) -> None:
        check_number("after_permit_ms", after_permit_ms, *AFTER_PERMIT_BOUNDS_MS, "ms")
        self._after_permit_ms = after_permit_ms
        self.state = BeamOnState()
        self.violation: str | None = None
        self._last_on_ns: int | None = None
        self._is_to_go_off = False

    def compare(self, permission: Permission, *, is_on: bool | None, now_ns: int) -> None:
        """Note a reading of the signal and the permit of the same moment."""
        self.state = replace(self.state, is_on=is_on)
        if is_on is None:
            return
        if is_on:
            self._last_on_ns = now_ns
            self._is_to_go_off = True
        if permission.since_ns is not None:
            self.violation = None
            self._look_for_absence(permission.since_ns, now_ns, is_on=is_on)
            self._is_to_go_off = is_on
            self.state = replace(self.state, violation=None)
            return
        self._look_for_violation(permission.ended_ns, now_ns, is_on=is_on)
        self.state = replace(self.state, is_absent=False, violation=self.violation)
        if not is_on and self._is_to_go_off:
            self._is_to_go_off = False
            self._note_off(permission.ended_ns, now_ns)

    def _look_for_absence(self, since_ns: int, now_ns: int, *, is_on: bool) -> None:
        missing_since_ns = max(since_ns, self._last_on_ns or since_ns)
        is_absent = not is_on and now_ns - missing_since_ns >= ABSENT_NS
        absences = self.state.absences + (is_absent and not self.state.is_absent)
        self.state = replace(self.state, is_absent=is_absent, absences=absences)

    def _look_for_violation(self, ended_ns: int | None, now_ns: int, *, is_on: bool) -> None:
        if not is_on:
            self.violation = None
        elif self.violation is None and ended_ns is None:
            self.violation = "the accelerator reports beam on, and nothing was permitted"
        elif self.violation is None and ended_ns is not None:
            over_ms = (now_ns - ended_ns) / NS_PER_MS
            if over_ms > self._after_permit_ms:
                bound = f"at most {self._after_permit_ms:g} ms are allowed"
                self.violation = f"the accelerator reports beam on {over_ms:.0f} ms after the permit ended: {bound}"

    def _note_off(self, ended_ns: int | None, now_ns: int) -> None:
        if ended_ns is None:
            return
        off_ms = (now_ns - ended_ns) / NS_PER_MS
        slowest_ms = max(off_ms, self.state.slowest_off_ms or 0.0)
        self.state = replace(self.state, last_off_ms=off_ms, slowest_off_ms=slowest_ms, offs=self.state.offs + 1)
