"""Whether the patient has breathed since a condition last let the beam on, by the condition's own signal.

The longest beam-on and the time of a breath hold belong to the patient's breath, not to the window in force: windows
are set, narrowed and set back while one breath is held. So the signal is compared with where it was when the beam was
on, and with the edges that were in force then. The patient has breathed where the signal has been, without a gap,

* beyond one of those edges by the hysteresis and three times its noise for `AWAY_S`,
* or a third of the learned breath away from where the beam was on, for as long,
* or beyond an edge for `OUT_S`, after it has moved by a third of the learned breath with the beam on: a window of a
  high duty cycle, or of phases. The beam-on since that movement then stays counted.

A new reference or model moves the scale of the signal: its place is then that of the next frame, and its edges are
those of the window in force where that lies between them.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

from engine.core.clock import NS_PER_MS, NS_PER_US
from engine.core.replacing import replace

AWAY_S = 0.3
OUT_S = 0.1
NOISES = 3.0
LEAST_MARGIN_MM = 0.1
"""Least way beyond an edge, also of a signal without noise; of the volume a tenth of a litre for each mm."""
BREATH_SHARE = 1.0 / 3.0
NOISE_WEIGHT = 1.0 / 30.0
SECOND_DIFFERENCE = math.sqrt(6.0 * 2.0 / math.pi)
"""Mean of abs(x[i] - 2 x[i-1] + x[i-2]) for normal noise of standard deviation 1: breathing hardly shows in it."""


class Edges(NamedTuple):
    """Edges of a window and its hysteresis, in the signal's unit."""

    lower: float
    upper: float
    hysteresis: float


class SignalNow(NamedTuple):
    """The signal of a condition in a frame, and what it is compared with.

    Attributes
    ----------
    value
        The signal [mm, l of the volume].
    at_us
        Device time [us].
    edges
        Of the window in force; None of a phase window.
    is_out
        Whether the frame lies outside of a phase window, with a phase that is known; False of any other.
    breath
        Depth of the learned breath in this signal; None where it is not known.
    per_mm
        What of the signal's unit counts as a millimetre.
    """

    value: float
    at_us: int
    edges: Edges | None
    is_out: bool
    breath: float | None
    per_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalTrail:
    """What is remembered of a condition's signal from frame to frame.

    Attributes
    ----------
    recent, at_us
        The last two values, the newest last, and when the newest was measured [us].
    noise
        Standard deviation of the signal's noise from frame to frame, over about a second.
    place, edges
        Where the signal was with the beam on, and the edges then; None before that, and the edges of a phase window.
    is_moved
        Whether the scale of the signal has changed: the next frame gives the place.
    moved_on_ns
        Beam-on time of the stay when the signal had moved by a third of a breath with the beam on; None if it has not.
    away_us, out_us
        Since when it has been away from the place, and beyond an edge [us]; None while it is not.
    is_over
        Whether the patient has breathed, and the breath hold has ended by it; until the beam is on again.
    """

    recent: tuple[float, ...] = ()
    at_us: int = 0
    noise: float = 0.0
    place: float | None = None
    edges: Edges | None = None
    is_moved: bool = False
    moved_on_ns: int | None = None
    away_us: int | None = None
    out_us: int | None = None
    is_over: bool = False

    @property
    def is_away_long(self) -> bool:
        """Whether the signal has been away for long enough now."""
        return self.away_us is not None and (self.at_us - self.away_us) / 1e6 >= AWAY_S

    def breathed_from_ns(self, on_ns: int) -> int | None:
        """Return the beam-on time of the old stay at which a new one starts [ns]; None if the patient has not breathed.

        ``on_ns``, that of the stay so far, where the patient has breathed since the beam was last on; earlier where the
        patient has breathed with the beam on, and has left the window since.
        """
        if self.is_over or self.is_away_long:
            return on_ns
        is_out = self.out_us is not None and (self.at_us - self.out_us) / 1e6 >= OUT_S
        return self.moved_on_ns if is_out else None

    def followed(self, now: SignalNow, max_gap_ms: float) -> "SignalTrail":
        """Return the trail after a frame that may be judged; a gap before it breaks what has to be without one."""
        is_next = 0 <= (now.at_us - self.at_us) * NS_PER_US <= max_gap_ms * NS_PER_MS
        recent = self.recent if is_next else ()
        noise = self.noise
        if len(recent) == 2:
            second = abs(now.value - 2.0 * recent[1] + recent[0])
            noise += NOISE_WEIGHT * (second / SECOND_DIFFERENCE - noise)
        place, edges = (now.value, _around(now)) if self.is_moved else (self.place, self.edges)
        beyond = _beyond(edges, now)
        is_away = place is not None and _is_away(now, place, edges, beyond, noise)
        away_us, out_us = (self.away_us, self.out_us) if is_next else (None, None)
        return replace(
            self,
            recent=(*recent, now.value)[-2:],
            at_us=now.at_us,
            noise=noise,
            is_moved=False,
            place=place,
            edges=edges,
            away_us=(now.at_us if away_us is None else away_us) if is_away else None,
            out_us=(now.at_us if out_us is None else out_us) if beyond > 0.0 else None,
        )

    def permitted(self, now: SignalNow, on_ns: int) -> "SignalTrail":
        """Return the trail after a frame with the beam on, or with a breath held; ``on_ns`` is that of the stay."""
        third = None if now.breath is None else BREATH_SHARE * now.breath
        has_moved = self.place is not None and third is not None and abs(now.value - self.place) >= third
        if self.place is None or has_moved:
            moved_on_ns = on_ns if has_moved else self.moved_on_ns
            return replace(self, place=now.value, edges=now.edges, moved_on_ns=moved_on_ns, is_over=False)
        return self if self.edges == now.edges and not self.is_over else replace(self, edges=now.edges, is_over=False)

    def begun(self, *, is_over: bool = False) -> "SignalTrail":
        """Return the trail of a new stay, or of a hold that is over in a stay that goes on."""
        return replace(self, place=None, edges=None, moved_on_ns=None, away_us=None, out_us=None, is_over=is_over)

    def rescaled(self) -> "SignalTrail":
        """Return the trail where the signal counts from another reference, or is measured with another model."""
        return SignalTrail(is_moved=self.place is not None or self.is_moved, noise=self.noise)


def _beyond(edges: Edges | None, now: SignalNow) -> float:
    """Return how far the signal lies beyond the edges of when the beam was on; infinite outside of the phases."""
    if edges is None:
        return math.inf if now.is_out else 0.0
    return max(edges.lower - now.value, now.value - edges.upper)


def _is_away(now: SignalNow, place: float, edges: Edges | None, beyond: float, noise: float) -> bool:
    """Whether the signal is away from where the beam was on, by its edges or by a third of the learned breath."""
    if now.breath is not None and abs(now.value - place) >= BREATH_SHARE * now.breath:
        return True
    return edges is not None and beyond > max(edges.hysteresis, NOISES * noise, LEAST_MARGIN_MM * now.per_mm)


def _around(now: SignalNow) -> Edges | None:
    """Return the edges in force if the signal lies between them."""
    return now.edges if now.edges is not None and now.edges.lower <= now.value <= now.edges.upper else None
