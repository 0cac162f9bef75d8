"""Every command that the engine carries out."""

from engine.core.commands import (
    Acknowledge,
    ActivateModel,
    ApplyModel,
    Arm,
    CorrectBaseline,
    Countersign,
    Disarm,
    HoldBeam,
    ReleaseBeam,
    Retrain,
    SetReference,
    SignPosition,
)
from engine.gating.window_change import SetWindow

Command = (
    Arm
    | Disarm
    | Acknowledge
    | SetReference
    | SignPosition
    | Countersign
    | Retrain
    | ApplyModel
    | ActivateModel
    | HoldBeam
    | ReleaseBeam
    | CorrectBaseline
    | SetWindow
)
