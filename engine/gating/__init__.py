"""May the beam be on: windows, limits and the reducer that decides, without input or output.

Outside of the engine a site names windows (:class:`GateWindow`) and limits (:class:`GateLimits`); the decisions are the
engine thread's.
"""

from engine.gating.active_window import (
    SetWindow,
)
from engine.gating.frame_checks import (
    HEAD_DIRECTION_UNKNOWN,
)
from engine.gating.limits import (
    BREATHING_CEASED,
    DWELL_MS,
    HYSTERESIS,
    LIMIT_BOUNDS,
    GateLimits,
)
from engine.gating.supervision.checks import (
    SEES_TOO_LITTLE,
    Check,
    CheckState,
)
from engine.gating.windows import (
    HOLD_BOUNDS,
    MAX_CONDITIONS,
    MAX_MOTION_MM,
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
    amplitude_window,
    initial_states,
)

__all__ = [
    "BREATHING_CEASED",
    "DWELL_MS",
    "HEAD_DIRECTION_UNKNOWN",
    "HOLD_BOUNDS",
    "HYSTERESIS",
    "LIMIT_BOUNDS",
    "MAX_CONDITIONS",
    "MAX_MOTION_MM",
    "SEES_TOO_LITTLE",
    "AmplitudeWindow",
    "BreathHoldWindow",
    "Check",
    "CheckState",
    "Condition",
    "ConditionState",
    "GateLimits",
    "GateWindow",
    "HoldKind",
    "HoldStage",
    "JoinedWindow",
    "PhaseWindow",
    "SetWindow",
    "Unit",
    "WindowInput",
    "amplitude_window",
    "initial_states",
]
