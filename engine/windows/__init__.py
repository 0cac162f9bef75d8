"""Gating windows: when the patient is where the beam may be. Amplitude, breath hold, phase; alone, or joined.

A window judges one trusted frame after the other and is pure: what it must remember is a value the gate keeps. Lengths
are motion against the reference [mm], positive towards the camera; volumes are litres; per cent are of the range the
patient breathed over while the model was learned, 0 at the end of exhale. Per cent are turned into mm or l once, when
the model or the reference changes: a window never follows the patient.

Nothing here can keep a beam on: a frame outside is outside at once.
"""

from engine.windows.amplitude import (
    MAX_MOTION_MM,
    MAX_PERCENT,
    MAX_VOLUME_L,
    MIN_PERCENT,
    AmplitudeWindow,
    Unit,
    amplitude_window,
)
from engine.windows.breath_hold import HOLD_BOUNDS, BreathHoldWindow, HoldKind
from engine.windows.conditions import (
    ConditionState,
    HoldStage,
    LearnedRange,
    Ranges,
    Sight,
    WindowVerdict,
    interrupted,
    left,
)
from engine.windows.joined import MAX_CONDITIONS, Condition, GateWindow, Join, JoinedWindow, at_rest
from engine.windows.phase import PhaseWindow
from engine.windows.signals import signal_of

__all__ = [
    "HOLD_BOUNDS",
    "MAX_CONDITIONS",
    "MAX_MOTION_MM",
    "MAX_PERCENT",
    "MAX_VOLUME_L",
    "MIN_PERCENT",
    "AmplitudeWindow",
    "BreathHoldWindow",
    "Condition",
    "ConditionState",
    "GateWindow",
    "HoldKind",
    "HoldStage",
    "Join",
    "JoinedWindow",
    "LearnedRange",
    "PhaseWindow",
    "Ranges",
    "Sight",
    "Unit",
    "WindowVerdict",
    "amplitude_window",
    "at_rest",
    "interrupted",
    "left",
    "signal_of",
]
