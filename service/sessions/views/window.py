"""The window as the gate judges by it, in the words of the live stream: edges in mm or l, moved and settled."""

from engine.core.breath import SignalChoice
from engine.core.frames import Measurement
from engine.core.signals import seen_share_of
from engine.gating import (
    AmplitudeWindow,
    BreathHoldWindow,
    Condition,
    ConditionState,
    GateWindow,
    JoinedWindow,
    PhaseWindow,
    Unit,
    WindowInput,
    initial_states,
)
from service.core.finite import rounded_or_none
from service.core.schemas.live_messages import LiveCondition, LiveWindow

DIGITS = 4


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
    return rounded_or_none(seen_share_of(leaf.choices[0], measurement.motion.seen))


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
                **_edges(leaf.level),
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
