"""The longest beam-on in an amplitude or phase window: a patient who breathes leaves the window in every breath.

Beam-on time counts from the patient's last breath (`engine.gating.windows.patient_breath`). Interruptions, arming,
another window and single frames beyond an edge do not reset it: a patient who holds the breath, and pictures that no
longer show the patient, stay inside. Breath holds have their own limit.
"""

from collections.abc import Iterable
from typing import NamedTuple

from engine.core.breath import Breath
from engine.core.clock import NS_PER_S
from engine.gating.limits import GateLimits
from engine.gating.windows import Join, JoinedWindow

BREATHS = 2.0
S_PER_MIN = 60.0


class Stay(NamedTuple):
    """A stay inside the window: the beam-on time of it that has ended, and the least that was allowed [ns]."""

    on_ns: int = 0
    allowed_ns: int | None = None

    def bounded(self, allowed_s: float | None) -> "Stay":
        """Return the stay with the lesser of what was and is allowed: in apnoea the rate is no longer known."""
        allowed_ns = None if allowed_s is None else int(allowed_s * NS_PER_S)
        if allowed_ns is None or (self.allowed_ns is not None and self.allowed_ns <= allowed_ns):
            return self
        return self._replace(allowed_ns=allowed_ns)

    def begun_at(self, from_ns: int) -> "Stay":
        """Return the stay of the next breath, which begins at ``from_ns`` of this one's beam-on time.

        That is negative while the beam is on: the beam-on time of the present run is added to it.
        """
        return Stay(on_ns=self.on_ns - from_ns)


OUTSIDE = Stay()


def allowed_on_s(breaths: Iterable[Breath], limits: GateLimits) -> float | None:
    """Return the longest beam-on in the window [s]: the site's, and two breaths where the rate is known.

    None where a breath hold, which has its own limit, is needed for the beam.
    """
    window = limits.window
    if limits.has_breath_hold:
        is_alternative = isinstance(window, JoinedWindow) and window.join is Join.OR
        return limits.max_beam_on_s if is_alternative else None
    longest_s = 0.0
    for breath in breaths:
        if breath.rate_per_min and breath.signal in window.choices:
            longest_s = max(longest_s, S_PER_MIN / breath.rate_per_min)
    return min(limits.max_beam_on_s, BREATHS * longest_s) if longest_s else limits.max_beam_on_s
