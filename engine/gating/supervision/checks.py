"""Which checks of the measurement could work: one that cannot finds nothing, so the beam does not rest on it.

The second estimate compares the surface, its colour and the scene with the reference (:mod:`engine.motion.cross_check`)
and says of each frame what it could compare; the markers are compared beside it (`PatientShift`). A check that worked
once holds the beam while it does not; one that has not worked since the reference holds it where the site needs all of
them. The age of the pictures is under the same rule (:mod:`engine.gating.delivery`).
"""

import enum
from typing import NamedTuple

from engine.core.clock import US_PER_S
from engine.core.frames import Evidence, Measurement
from engine.core.gate_state import HoldReason
from engine.core.sentences import say
from engine.gating.gate import Interruption
from engine.gating.limits import MAX_UNCHECKED_US, GateLimits

NOTHING = Evidence(surface=False, color=False, camera=False, colored_share=0.0)


class Check(enum.StrEnum):
    """A check of the measurement against the reference. The value is the stable code."""

    SURFACE = "surface"
    COLOR = "color"
    CAMERA = "camera"
    MARKERS = "markers"


SEES_TOO_LITTLE = {
    Check.SURFACE: say("too little of the region's surface is seen"),
    Check.COLOR: say("too little of the region has a colour: it is too dark"),
    Check.CAMERA: say("too little of couch and floor is seen"),
    Check.MARKERS: say("the markers' positions are not compared"),
}


class CheckState(NamedTuple):
    """Whether a check works, and since when it does or does not.

    Attributes
    ----------
    is_on
        Whether the newest measured frame was compared.
    since_us
        Device time of the first frame in that state [us].
    was_on
        Whether it has worked since the reference was set.
    """

    check: Check
    is_on: bool
    since_us: int
    was_on: bool


class Checks:
    """Follows the checks from the reference on; owned by the engine thread.

    Attributes
    ----------
    states
        One state a check; empty without a reference, and until a frame was measured after it.
    """

    def __init__(self, limits: GateLimits) -> None:
        self._needs_all = limits.needs_all_checks
        self.states: tuple[CheckState, ...] = ()

    def reset(self) -> None:
        """Forget which checks have worked: the reference was set."""
        self.states = ()

    def check(self, measurement: Measurement, *, has_reference: bool, has_markers: bool) -> Interruption | None:
        """Return the hold for a check that cannot work; a frame that was not measured holds by itself.

        ``has_markers``: the markers' positions of this frame were compared with those at the reference.
        """
        if not has_reference:
            self.reset()
            return None
        if measurement.motion is None:
            return None
        evidence, now_us = measurement.evidence or NOTHING, measurement.timestamp_us
        works = {
            Check.SURFACE: evidence.surface,
            Check.COLOR: evidence.color,
            Check.CAMERA: evidence.camera,
            Check.MARKERS: has_markers,
        }
        before = {state.check: state for state in self.states}
        self.states = tuple(_followed(before.get(check), check, now_us, is_on=works[check]) for check in Check)
        return next(filter(None, (self._hold(state, now_us) for state in self.states)), None)

    def _hold(self, state: CheckState, now_us: int) -> Interruption | None:
        if state.is_on:
            return None
        if not state.was_on:
            detail = say(
                "{check}, not once since the reference: {why}",
                check=state.check,
                why=SEES_TOO_LITTLE[state.check],
            )
            return Interruption(HoldReason.CHECK_MISSING, detail) if self._needs_all else None
        off_us = now_us - state.since_us
        if 0 <= off_us <= MAX_UNCHECKED_US:
            return None
        detail = say(
            "{check}, for {off_s:.1f} s: {why}",
            check=state.check,
            off_s=off_us / US_PER_S,
            why=SEES_TOO_LITTLE[state.check],
        )
        return Interruption(HoldReason.CHECK_MISSING, detail)


def _followed(before: CheckState | None, check: Check, now_us: int, *, is_on: bool) -> CheckState:
    if before is None:
        return CheckState(check, is_on, now_us, is_on)
    if before.is_on is is_on:
        return before
    return CheckState(check, is_on, now_us, before.was_on or is_on)
