"""The window as the gate judges by it, in the words of the live stream: edges in mm or l, moved and settled."""

from engine.breath import SignalChoice
from engine.windows import (
    AmplitudeWindow,
    BreathHoldWindow,
    Condition,
    ConditionState,
    GateWindow,
    JoinedWindow,
    PhaseWindow,
    Unit,
    at_rest,
)
from service.live_messages import LiveCondition, LiveWindow

DIGITS = 4


def live_window(window: GateWindow, states: tuple[ConditionState, ...] = ()) -> LiveWindow:
    """Tell the window, condition by condition, with where each stands."""
    kept = states if len(states) == len(window.leaves) else at_rest(window)
    conditions = [_condition(leaf, state) for leaf, state in zip(window.leaves, kept, strict=True)]
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


def _condition(leaf: Condition, state: ConditionState) -> LiveCondition:
    match leaf:
        case PhaseWindow():
            return LiveCondition(
                kind="phase",
                **_place(leaf.choice),
                from_percent=leaf.from_percent,
                to_percent=leaf.to_percent,
                min_confidence=leaf.min_confidence,
                is_inside=state.is_inside,
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
                is_inside=state.is_inside,
                stage=state.stage.value,
            )
    return LiveCondition(kind="amplitude", **_place(leaf.choice), **_edges(leaf), is_inside=state.is_inside)


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
