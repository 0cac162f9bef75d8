"""Breath and breath hold for the live stream and a session's detail; unknown values are null.

The window as the gate judges by it, in the words of the live stream: edges in mm or l, moved and settled.
"""

from engine.control import LiveView
from engine.core.breath import Breath, BreathEventKind, SignalChoice
from engine.core.frames import Measurement
from engine.gating import (
    AmplitudeWindow,
    BreathHoldWindow,
    Condition,
    ConditionState,
    GateWindow,
    HoldKind,
    HoldStage,
    JoinedWindow,
    PhaseWindow,
    Unit,
    WindowInput,
    initial_states,
)
from service.core.schemas.base import rounded_or_none
from service.core.schemas.live_messages import LiveBreath, LiveBreathEvent, LiveBreathHold, LiveCondition, LiveWindow

US_PER_S = 1e6
DIGITS = 4
OF_A_HOLD = {BreathEventKind.SIGH, BreathEventKind.APNOEA, BreathEventKind.IRREGULAR, BreathEventKind.NO_CYCLE}
"""What a breath that is held on purpose looks like: no events while a breath hold is prescribed."""


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
        events=_events(breath, view.window, view.record.measurement.timestamp_us),
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


def _events(breath: Breath, window: GateWindow, now_us: int) -> list[LiveBreathEvent]:
    left_out = OF_A_HOLD if any(isinstance(leaf, BreathHoldWindow) for leaf in window.leaves) else set()
    return [
        LiveBreathEvent(
            kind=event.kind.value,
            confidence=round(event.confidence, DIGITS),
            since_s=round(max(now_us - event.start_us, 0) / US_PER_S, 2),
            detail=event.detail,
        )
        for event in breath.events
        if event.kind not in left_out
    ]


def live_window(
    window: GateWindow, states: tuple[ConditionState, ...] = (), measurement: Measurement | None = None
) -> LiveWindow:
    """Return the window with its conditions, and for each whether the frame meets it."""
    kept = states if len(states) == len(window.leaves) else initial_states(window)
    conditions = [
        _condition(leaf, state, is_inside=_is_inside(leaf, state, measurement)).model_copy(
            update={"seen_share": _seen_share(leaf, measurement)}
        )
        for leaf, state in zip(window.leaves, kept, strict=True)
    ]
    first = conditions[0]
    in_mm = first.unit == "mm"
    return LiveWindow(
        signal=first.signal,
        row=first.row,
        column=first.column,
        lower_mm=first.lower if in_mm else None,
        upper_mm=first.upper if in_mm else None,
        hysteresis_mm=first.hysteresis if in_mm else None,
        join=window.join if isinstance(window, JoinedWindow) else "and",
        conditions=conditions,
    )


def _is_inside(leaf: Condition, state: ConditionState, measurement: Measurement | None) -> bool:
    """Evaluate one condition for the frame: the gate keeps only the result of all conditions together."""
    gated = None if measurement is None else measurement.as_gated
    if gated is None or gated.motion is None:
        return False
    sight = WindowInput(gated.motion, gated.breaths, gated.timestamp_us)
    return leaf.judge(sight, (state,)).is_inside


def _seen_share(leaf: Condition, measurement: Measurement | None) -> float | None:
    """Return how much of the condition's signal the frame shows; None while nothing is measured."""
    if measurement is None or measurement.motion is None:
        return None
    return rounded_or_none(leaf.choices[0].seen_in(measurement.motion.seen))


def _condition(leaf: Condition, state: ConditionState, *, is_inside: bool) -> LiveCondition:
    match leaf:
        case PhaseWindow():
            return LiveCondition(
                kind="phase",
                **_place(leaf.choice),
                from_percent=leaf.from_percent,
                to_percent=leaf.to_percent,
                min_confidence=leaf.min_confidence,
                is_inside=is_inside,
            )
        case BreathHoldWindow():
            return LiveCondition(
                kind="breath_hold",
                **_place(leaf.level.choice),
                **(_edges(leaf.level) if leaf.is_level_set else {"unit": leaf.level.choice.unit}),
                hold=leaf.kind,
                settle_ms=leaf.settle_ms,
                still=leaf.still,
                max_drift=leaf.max_drift,
                timeout_s=leaf.timeout_s,
                is_inside=is_inside,
                stage=state.stage.value,
            )
    return LiveCondition(kind="amplitude", **_place(leaf.choice), **_edges(leaf), is_inside=is_inside)


def _place(choice: SignalChoice) -> dict[str, object]:
    return {
        "signal": choice.signal,
        "row": choice.row,
        "column": choice.column,
        "name": choice.name,
        "label": choice.label,
    }


def _edges(window: AmplitudeWindow) -> dict[str, object]:
    numbers = {"lower": window.lower, "upper": window.upper, "hysteresis": window.hysteresis}
    return {"unit": Unit(window.unit).value, **{name: round(value, DIGITS) for name, value in numbers.items()}}
