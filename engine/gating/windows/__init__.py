"""Gating windows: amplitude, breath hold and phase, alone or joined.

A window is a pure function of one checked frame and the states of its conditions, which the gate stores. Lengths are
motion against the reference [mm], positive towards the camera; volumes are litres; per cent refer to the breathing
range of the training, 0 at the end of exhale. Per cent are converted to mm or l once, when the model or the reference
changes: a window never follows the patient.

No window can prolong beam on: a frame outside is outside at once.
"""

from engine.gating.windows.amplitude import (
    MAX_MOTION_MM,
    MAX_PERCENT,
    MAX_VOLUME_L,
    MIN_PERCENT,
    AmplitudeWindow,
    Unit,
    amplitude_window,
)
from engine.gating.windows.breath_hold import HOLD_BOUNDS, LEVEL_NOT_SET, BreathHoldWindow, HoldKind
from engine.gating.windows.conditions import (
    BreathDepth,
    ConditionState,
    HoldStage,
    WindowInput,
    WindowVerdict,
    armed_again,
    breath_depths,
    interrupted,
    left,
    rescaled,
)
from engine.gating.windows.phase import (
    MAX_CONDITIONS,
    Condition,
    GateWindow,
    Join,
    JoinedWindow,
    PhaseWindow,
    begun,
    breathed_from_ns,
    followed,
    initial_states,
    is_held,
    permitted,
)

__all__ = [
    "HOLD_BOUNDS",
    "LEVEL_NOT_SET",
    "MAX_CONDITIONS",
    "MAX_MOTION_MM",
    "MAX_PERCENT",
    "MAX_VOLUME_L",
    "MIN_PERCENT",
    "AmplitudeWindow",
    "BreathDepth",
    "BreathHoldWindow",
    "Condition",
    "ConditionState",
    "GateWindow",
    "HoldKind",
    "HoldStage",
    "Join",
    "JoinedWindow",
    "PhaseWindow",
    "Unit",
    "WindowInput",
    "WindowVerdict",
    "amplitude_window",
    "armed_again",
    "begun",
    "breath_depths",
    "breathed_from_ns",
    "followed",
    "initial_states",
    "interrupted",
    "is_held",
    "left",
    "permitted",
    "rescaled",
]
