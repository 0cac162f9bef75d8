"""Breath and breath hold for the live stream and a session's detail; unknown values are null."""

from engine.control import LiveView
from engine.core.breath import Breath, SignalChoice
from engine.gating import BreathHoldWindow, ConditionState, HoldKind, HoldStage
from service.core.finite import rounded_or_none
from service.core.schemas.live_messages import LiveBreath, LiveBreathEvent, LiveBreathHold

US_PER_S = 1e6
DIGITS = 4


def gated_breath(breaths: tuple[Breath, ...], choice: SignalChoice) -> Breath | None:
    """Return the breath of the window's first signal; None where it is not followed."""
    return next((breath for breath in breaths if breath.signal == choice), None)


def live_breath(view: LiveView) -> LiveBreath | None:
    """Return phase, rate and level of the gated signal's breath; None where it is not followed."""
    breath = gated_breath(view.record.measurement.breaths, view.window.choices[0])
    if breath is None:
        return None
    return LiveBreath(
        signal=breath.signal.label,
        unit=breath.signal.unit,
        phase_percent=rounded_or_none(breath.phase_percent),
        phase_confidence=round(breath.phase_confidence, DIGITS),
        note=breath.note if breath.phase_percent is None else "",
        rate_per_min=rounded_or_none(breath.rate_per_min),
        rate_confidence=round(breath.rate_confidence, DIGITS),
        amplitude=rounded_or_none(breath.amplitude),
        baseline=rounded_or_none(breath.baseline),
        drift=rounded_or_none(breath.drift),
        drift_per_s=rounded_or_none(breath.drift_per_s),
        regularity=rounded_or_none(breath.regularity),
        events=_events(breath, view.record.measurement.timestamp_us),
    )


def live_breath_hold(view: LiveView) -> LiveBreathHold | None:
    """Return the state of the breath hold; None where the window has none."""
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
    """Return how long the stage has lasted [s]; None while the breath hold is awaited."""
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
