"""The accelerator's beam-on signal compared with the permit, in both directions.

A beam without a permit is a fault. A permit without a beam is reported and holds nothing: the accelerator may be
waiting for a person. Permitted time without a beam is added up over permits, because in free breathing none lasts long.
The time from the end of each permit to the beam off is measured.

Pure: the caller passes times and readings. `engine.beam.compared_line` is the line that uses it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from engine.core.bounds import check_number
from engine.core.clock import NS_PER_MS, NS_PER_S
from engine.core.replacing import replace
from engine.core.sentences import say

AFTER_PERMIT_BOUNDS_MS = (20.0, 1000.0)
AFTER_PERMIT_MS = 250.0
"""Default of the longest time that the beam may be on after its permit has ended."""

ABSENT_BOUNDS_S = (1.0, 120.0)
ABSENT_S = 10.0
"""Default of the permitted time without a beam after which it is reported."""

KEPT_OFFS = 8
"""Number of the newest holds whose time to beam off is kept; a reader that looks at every frame misses none."""

ReadBeamOn: TypeAlias = Callable[[], bool | None]
"""Newest reading of the accelerator's signal, any thread, without waiting; None where it is not known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamOff:
    """One permit that ended while the beam was on.

    Attributes
    ----------
    number
        1 for the first of the line, rising by one.
    ended_ns
        End of the permit: its first hold, or the end of the lease [ns, host monotonic].
    off_ms
        From then to the first reading without a beam [ms].
    """

    number: int
    ended_ns: int
    off_ms: float


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamOnState:
    """What the comparison knows; for display.

    Attributes
    ----------
    is_on
        Newest reading; None where it is not known.
    is_absent
        Whether the beam was permitted for longer than the bound without one, since the last beam or arming.
    absences
        Number of times that this began.
    last_off_ms, slowest_off_ms
        Time from the end of a permit to the beam off, of the last hold and of the slowest [ms]; None before the first.
    offs
        Number of holds of which it was measured.
    newest_offs
        The newest of them, oldest first; at most `KEPT_OFFS`.
    violation
        Why the beam is on without a permit; None where it is not.
    """

    is_on: bool | None = None
    is_absent: bool = False
    absences: int = 0
    last_off_ms: float | None = None
    slowest_off_ms: float | None = None
    offs: int = 0
    newest_offs: tuple[BeamOff, ...] = ()
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

    def __init__(self, *, after_permit_ms: float = AFTER_PERMIT_MS, absent_s: float = ABSENT_S) -> None:
        check_number("after_permit_ms", after_permit_ms, *AFTER_PERMIT_BOUNDS_MS, "ms")
        check_number("absent_s", absent_s, *ABSENT_BOUNDS_S, "s")
        self._after_permit_ms = after_permit_ms
        self._absent_ns = round(absent_s * NS_PER_S)
        self.state = BeamOnState()
        self.violation: str | None = None
        self._missing_ns = 0
        self._compared_ns: int | None = None
        self._is_to_go_off = False

    def compare(self, permission: Permission, *, is_on: bool | None, now_ns: int) -> None:
        """Note a reading of the signal and the permit of the same moment."""
        before_ns, self._compared_ns = self._compared_ns, now_ns
        self.state = replace(self.state, is_on=is_on)
        if is_on is None:
            return
        if is_on:
            self._is_to_go_off = True
            self.forget_absence()
        if permission.since_ns is not None:
            self.violation = None
            self.state = replace(self.state, violation=None)
            if not is_on:
                self._look_for_absence(max(permission.since_ns, before_ns or permission.since_ns), now_ns)
            self._is_to_go_off = is_on
            return
        self._look_for_violation(permission.ended_ns, now_ns, is_on=is_on)
        self.state = replace(self.state, violation=self.violation)
        if not is_on and self._is_to_go_off:
            self._is_to_go_off = False
            self._note_off(permission.ended_ns, now_ns)

    def forget_absence(self) -> None:
        """Reset the sum of the permitted time without a beam."""
        self._missing_ns = 0
        self.state = replace(self.state, is_absent=False)

    def _look_for_absence(self, since_ns: int, now_ns: int) -> None:
        """Add the permitted time since the last reading, and note when it exceeds the bound."""
        self._missing_ns += now_ns - since_ns
        is_absent = self._missing_ns >= self._absent_ns
        absences = self.state.absences + (is_absent and not self.state.is_absent)
        self.state = replace(self.state, is_absent=is_absent, absences=absences)

    def _look_for_violation(self, ended_ns: int | None, now_ns: int, *, is_on: bool) -> None:
        if not is_on:
            self.violation = None
        elif self.violation is None and ended_ns is None:
            self.violation = say("the accelerator reports beam on, and nothing was permitted")
        elif self.violation is None and ended_ns is not None:
            over_ms = (now_ns - ended_ns) / NS_PER_MS
            if over_ms > self._after_permit_ms:
                bound = say("at most {after_permit_ms:g} ms are allowed", after_permit_ms=self._after_permit_ms)
                self.violation = say(
                    "the accelerator reports beam on {over_ms:.0f} ms after the permit ended: {bound}",
                    over_ms=over_ms,
                    bound=bound,
                )

    def _note_off(self, ended_ns: int | None, now_ns: int) -> None:
        if ended_ns is None:
            return
        off_ms = (now_ns - ended_ns) / NS_PER_MS
        one = BeamOff(number=self.state.offs + 1, ended_ns=ended_ns, off_ms=off_ms)
        self.state = replace(
            self.state,
            last_off_ms=off_ms,
            slowest_off_ms=max(off_ms, self.state.slowest_off_ms or 0.0),
            offs=one.number,
            newest_offs=(*self.state.newest_offs, one)[-KEPT_OFFS:],
        )
