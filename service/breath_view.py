"""The breath and the breath hold as the live stream and a session's detail tell them; what cannot be told is null."""

import math

from engine.breath import Breath
from engine.live import LiveView
from engine.windows import BreathHoldWindow, ConditionState, HoldKind, HoldStage
from service.baseline import gated_breath
from service.live_messages import LiveBreath, LiveBreathEvent, LiveBreathHold

US_PER_S = 1e6
DIGITS = 4


def live_breath(view: LiveView) -> LiveBreath | None:
    """Tell where the gated signal stands in the breath; None where nobody follows it."""
    breath = gated_breath(view.record.measurement.breaths, view.window.choices[0])
    if breath is None:
        return None
    return LiveBreath(
        signal=breath.signal.label,
        unit="l" if breath.signal.is_volume else "mm",
        phase_percent=_rounded(breath.phase_percent),
        phase_confidence=round(breath.phase_confidence, DIGITS),
        note=breath.note if breath.phase_percent is None else "",
        rate_per_min=_rounded(breath.rate_per_min),
        rate_confidence=round(breath.rate_confidence, DIGITS),
        amplitude=_rounded(breath.amplitude),
        baseline=_rounded(breath.baseline),
        drift=_rounded(breath.drift),
        drift_per_s=_rounded(breath.drift_per_s),
        regularity=_rounded(breath.regularity),
        events=_events(breath, view.record.measurement.timestamp_us),
    )


def live_breath_hold(view: LiveView) -> LiveBreathHold | None:
    """Tell where the breath hold stands; None where the window has none."""
    leaves = view.window.leaves
    states = view.conditions if len(view.conditions) == len(leaves) else tuple(ConditionState() for _ in leaves)
    for window, state in zip(leaves, states, strict=True):
        if isinstance(window, BreathHoldWindow):
            return LiveBreathHold(
                hold=HoldKind(window.kind).value,
                stage=state.stage.value,
                count=view.breath_holds,
                seconds=_since_s(state, view.record.measurement.timestamp_us),
                settle_s=window.settle_ms / 1000.0,
                timeout_s=window.timeout_s,
            )
    return None


def _since_s(state: ConditionState, now_us: int) -> float | None:
    """Return how long the stage has lasted [s]; nobody counts while the breath is awaited."""
    return None if state.stage is HoldStage.AWAITED else round(max(now_us - state.since_us, 0) / US_PER_S, 2)


def _events(breath: Breath, now_us: int) -> list[LiveBreathEvent]:
    return [
        LiveBreathEvent(
            kind=event.kind.value,
            confidence=round(event.confidence, DIGITS),
            since_s=round(max(now_us - event.start_us, 0) / US_PER_S, 2),
            detail=event.detail,
        )
        for event in breath.events
    ]


def _rounded(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else round(float(value), DIGITS)
