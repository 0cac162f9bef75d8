"""The level at which the patient breathes: an amplitude window has its meaning only while the end of exhale stays.

A patient who lies some millimetres lower meets the same window at another moment of the breath. So the last end of
exhale is compared with where it was when the reference was set, or where a person has confirmed it; it is known when
the next inhale has begun. After more than a second without a measurement, or a jump of a gated signal, the patient may
lie elsewhere: before the beam may be on, the surface's height without breathing has to be within the bound, or an end
of exhale has to be seen. An expiration hold is at the end of exhale itself; inspiration holds and phases have their own
rules.
"""

from collections.abc import Iterator
from typing import NamedTuple

from engine.core.breath import Breath, SignalChoice
from engine.core.clock import US_PER_S
from engine.core.frames import Measurement, Motion
from engine.core.gate_state import HoldReason
from engine.core.sentences import say
from engine.core.signals import signal_of
from engine.gating.frame_checks import MAX_JUMP_FRAMES
from engine.gating.gate import Interruption
from engine.gating.limits import GateLimits
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, Condition, GateWindow, HoldKind

HALF = 0.5
BREATH_SHARE = 1.0 / 3.0
RETURNED = 0.9
"""A drift ends at this share of its bound."""
LONGEST_UNMEASURED_US = 1_000_000


class _Level(NamedTuple):
    """A gated signal's end of exhale, and the largest drift of it that does not hold."""

    choice: SignalChoice
    breath: Breath
    bound: float


class Baseline:
    """Compares the ends of exhale with those at the reference; owned by the engine thread."""

    def __init__(self, limits: GateLimits) -> None:
        self._max_mm = limits.max_baseline_drift_mm
        self._drifted: dict[SignalChoice, Interruption] = {}
        self._measured_us: int | None = None
        self._unknown_since_us: int | None = None
        self._why_unknown = ""
        self._max_jump_mm = limits.max_jump_mm
        self._before: tuple[int, dict[SignalChoice, float]] | None = None

    def reset(self) -> None:
        """Accept the patient's present level: the reference was set."""
        self._drifted.clear()
        self._unknown_since_us = self._before = None

    def check(self, measurement: Measurement, window: GateWindow, *, has_reference: bool = True) -> Interruption | None:
        """Return the hold for a level that is elsewhere, or not known since the last gap."""
        if not has_reference:
            self.reset()
        if measurement.motion is None:
            return None  # the frame itself holds
        now_us = measurement.timestamp_us
        before_us, self._measured_us = self._measured_us, now_us
        if before_us is not None and not 0 <= now_us - before_us <= LONGEST_UNMEASURED_US:
            gap_s = abs(now_us - before_us) / US_PER_S
            self._unknown_since_us, self._why_unknown = now_us, say("not measured for {gap_s:.1f} s", gap_s=gap_s)
        levels = list(_levels(measurement, window, self._max_mm))
        self._note_jump(measurement.motion, measurement.frame_index, now_us, levels)
        if self._unknown_since_us is not None and levels:
            if not all(_is_known(one, measurement, self._unknown_since_us) for one in levels):
                detail = say(
                    "{why_unknown}, and the patient may lie elsewhere: "
                    "an end of exhale has to be seen, or set the reference again",
                    why_unknown=self._why_unknown,
                )
                return Interruption(HoldReason.BASELINE_DRIFTED, detail)
            self._unknown_since_us = None
        return next((hold for one in levels if (hold := self._drift(one)) is not None), None)

    def _note_jump(self, motion: Motion, frame_index: int, now_us: int, levels: list[_Level]) -> None:
        """Forget the level where a gated signal has jumped since the last measured frame."""
        signals = {one.choice: signal_of(one.choice, motion) for one in levels}
        before, self._before = self._before, (frame_index, signals)
        if before is None or before[1].keys() != signals.keys():
            return
        frames = min(max(frame_index - before[0], 1), MAX_JUMP_FRAMES)
        steps_mm = [abs(now - before[1][choice]) / choice.per_mm for choice, now in signals.items()]
        if not max(steps_mm, default=0.0) <= self._max_jump_mm * frames:
            self._unknown_since_us, self._why_unknown = (
                now_us,
                say("jumped by {step_mm:.1f} mm", step_mm=max(steps_mm)),
            )

    def _drift(self, level: _Level) -> Interruption | None:
        choice, drift = level.choice, level.breath.exhale_drift
        allowed = level.bound * (RETURNED if choice in self._drifted else 1.0)
        if drift is None:
            return self._drifted.get(choice)  # a cough hides the end of exhale: nothing has come back
        if abs(drift) <= allowed:
            self._drifted.pop(choice, None)
            return None
        way = say("towards") if drift > 0.0 else say("away from")
        detail = say(
            "{label}: the end of exhale is {drift:.2g} {unit} {way} the camera, "
            "{allowed:.2g} allowed: correct the baseline, or set the reference again",
            label=choice.label,
            drift=abs(drift),
            unit=choice.unit,
            way=way,
            allowed=allowed,
        )
        self._drifted[choice] = Interruption(HoldReason.BASELINE_DRIFTED, detail)
        return self._drifted[choice]


def _is_known(level: _Level, measurement: Measurement, since_us: int) -> bool:
    """Return whether the level is known since a gap: by the surface's height, or by an end of exhale."""
    position, exhale_us = measurement.position, level.breath.exhale_us
    is_as_high = (
        position is not None
        and position.measured_us >= since_us
        and abs(position.height_mm) <= level.bound / level.choice.per_mm
    )
    return is_as_high or (exhale_us is not None and exhale_us >= since_us)


def _edges_at_exhale(leaf: Condition) -> AmplitudeWindow | None:
    """Return the edges that have their meaning only while the end of exhale stays."""
    if isinstance(leaf, BreathHoldWindow):
        return leaf.level if leaf.kind is HoldKind.EXPIRATION else None
    return leaf if isinstance(leaf, AmplitudeWindow) else None


def _levels(measurement: Measurement, window: GateWindow, max_mm: float) -> Iterator[_Level]:
    """Yield the levels of the amplitude conditions and expiration holds whose breath is followed."""
    breaths = {breath.signal: breath for breath in measurement.breaths}
    for leaf in map(_edges_at_exhale, window.leaves):
        breath = None if leaf is None else breaths.get(leaf.choice)
        if leaf is not None and breath is not None:
            bounds = [max_mm * leaf.choice.per_mm]
            if not leaf.needs_ranges:
                bounds.append(HALF * (leaf.upper - leaf.lower))
            if breath.amplitude is not None:
                bounds.append(BREATH_SHARE * breath.amplitude)
            yield _Level(leaf.choice, breath, min(bounds))
