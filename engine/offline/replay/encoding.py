"""Encodes values of the engine as JSON and decodes them, to the last bit.

Only classes of a closed table are encoded or decoded, so that a tape can make values and nothing else. Python's JSON
writes a float with as many digits as distinguish it from every other.
"""

import dataclasses
import enum
from collections.abc import Callable
from typing import Any, get_args

from engine.capture.source import SourceDescription
from engine.control.commands import Command
from engine.control.turn_inputs import CommandInputs, FrameInput, LineAnswer, TurnInputs
from engine.core.breath import BreathEventKind, GateSignal, SignalChoice
from engine.core.errors import InvalidValueError, ModelError, RecordingError
from engine.core.gate_state import GateState, HoldReason
from engine.core.head_direction import HeadDirection
from engine.core.motion_model import MotionModel
from engine.core.reference_proposal import ReferenceMoment
from engine.gating.gate import Interruption
from engine.gating.interlocks import DecisionInputs
from engine.gating.limits import GateLimits
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, HoldKind, Join, JoinedWindow, PhaseWindow, Unit
from engine.motion.learning.patient_match import PatientMatchLimits
from engine.motion.learning.trainer import TrainingSettings
from engine.motion.named_regions import NamedRegion
from engine.motion.settings import PipelineSettings
from engine.offline.replay.inputs import FrameHead, Raised

_UNDECODABLE = (LookupError, TypeError, ValueError, AttributeError, RecursionError, InvalidValueError, ModelError)
_TAPE_NAMES: dict[type, str] = {PatientMatchLimits: "LikenessLimits"}
"""Classes that were renamed: tapes keep the name from when they were first written."""
_INPUTS = (TurnInputs, CommandInputs, FrameInput, DecisionInputs, LineAnswer)
"""Several are on each turn of a tape, mostly with defaults, which are omitted."""
_CLASSES: dict[str, type] = {
    _TAPE_NAMES.get(known, known.__name__): known
    for known in (
        *get_args(Command),
        *(
            GateLimits,
            AmplitudeWindow,
            BreathHoldWindow,
            JoinedWindow,
            PhaseWindow,
            SignalChoice,
        ),
        *(PipelineSettings, TrainingSettings, PatientMatchLimits, NamedRegion, SourceDescription, Interruption),
        *(FrameHead, Raised, *_INPUTS),
    )
}
_ENUMS: dict[str, type[enum.Enum]] = {
    known.__name__: known
    for known in (
        *(BreathEventKind, GateSignal, GateState, HeadDirection, HoldReason, HoldKind, Join, ReferenceMoment, Unit),
    )
}


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TapeEncoding:
    """Encodes and decodes values; a motion model by the name that ``name_of`` returns and ``model_of`` finds."""

    name_of: Callable[[MotionModel], str]
    model_of: Callable[[str], MotionModel]

    def encode(self, value: Any) -> Any:  # noqa: ANN401 - any of the table's values, as any of JSON's
        """Return a value as JSON; raise TypeError for a class that is not in the table."""
        if isinstance(value, enum.Enum):
            return {"e": [type(value).__name__, value.value]}
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if isinstance(value, list | tuple):
            return {"l" if isinstance(value, list) else "t": [self.encode(one) for one in value]}
        if isinstance(value, frozenset):
            return {"s": sorted((self.encode(one) for one in value), key=str)}
        if isinstance(value, MotionModel):
            return {"m": self.name_of(value)}
        name = _TAPE_NAMES.get(type(value), type(value).__name__)
        if _CLASSES.get(name) is not type(value):
            msg = f"a {name} has no place on a tape"
            raise TypeError(msg)
        return {"d": [name, {one.name: self.encode(getattr(value, one.name)) for one in _stored_fields(value)}]}

    def decode(self, encoded: Any) -> Any:  # noqa: ANN401
        """Return the value of this JSON; raise RecordingError where it has none."""
        if not isinstance(encoded, dict):
            return encoded
        try:
            ((kind, body),) = encoded.items()
            return self._decoded(kind, body)
        except _UNDECODABLE as error:
            msg = f"the tape is damaged: {type(error).__name__} in {str(encoded)[:60]}"
            raise RecordingError(msg) from error

    def _decoded(self, kind: str, body: Any) -> Any:  # noqa: ANN401
        match kind:
            case "e":
                return _ENUMS[body[0]](body[1])
            case "d":
                return _CLASSES[body[0]](**{name: self.decode(one) for name, one in body[1].items()})
            case "m":
                return self.model_of(body)
        makers: dict[str, type] = {"l": list, "t": tuple, "s": frozenset}
        return makers[kind](self.decode(one) for one in body)


def _stored_fields(value: Any) -> list["dataclasses.Field[Any]"]:  # noqa: ANN401 - a value of the table
    """Return a value's fields; of an engine's inputs only those that differ from their defaults."""
    fields = list(dataclasses.fields(value))
    if not isinstance(value, _INPUTS):
        return fields
    return [one for one in fields if getattr(value, one.name) != one.default]
