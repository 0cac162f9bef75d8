"""Encodes values of the engine as JSON and decodes them, to the last bit.

Only classes of a closed table are encoded or decoded, so that a tape can make values and nothing else. Python's JSON
writes a float with as many digits as distinguish it from every other.

The part of a reading that goes onto a tape, where the whole is too large or cannot be stored.
"""

import dataclasses
import enum
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, get_args

from engine.capture.source import SourceDescription
from engine.control.turn_inputs import Command, CommandInputs, FrameInput, LineAnswer, TurnInputs
from engine.core import errors
from engine.core.breath import BreathEventKind, GateSignal, SignalChoice
from engine.core.errors import InvalidValueError, ModelError, RecordingError
from engine.core.frames import ColorImage, DepthImage, RgbdFrame
from engine.core.gate_state import GateState, HoldReason
from engine.core.input_tap import InputKind
from engine.core.motion_model import MotionModel
from engine.core.reference import ReferenceMoment
from engine.core.signals import HeadDirection
from engine.gating.gate import Interruption
from engine.gating.interlocks import DecisionInputs
from engine.gating.limits import GateLimits
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, HoldKind, Join, JoinedWindow, PhaseWindow, Unit
from engine.motion.learning.patient_match import PatientMatchLimits
from engine.motion.learning.trainer import TrainingSettings
from engine.motion.named_regions import NamedRegion
from engine.motion.settings import PipelineSettings

_UNDECODABLE = (LookupError, TypeError, ValueError, AttributeError, RecursionError, InvalidValueError, ModelError)
_TAPE_NAMES: dict[type, str] = {PatientMatchLimits: "LikenessLimits"}
"""Classes that were renamed: tapes keep the name from when they were first written."""
_INPUTS = (TurnInputs, CommandInputs, FrameInput, DecisionInputs, LineAnswer)
"""Several are on each turn of a tape, mostly with defaults, which are omitted."""
_ENUMS: dict[str, type[enum.Enum]] = {
    known.__name__: known
    for known in (
        *(BreathEventKind, GateSignal, GateState, HeadDirection, HoldReason, HoldKind, Join, ReferenceMoment, Unit),
    )
}


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameHead:
    """A frame without its pictures, which are in a recording."""

    index: int
    device_index: int
    missed_frames: int
    timestamp_us: int
    color_timestamp_us: int
    received_ns: int
    queue_empty_ns: int | None = None

    def with_pictures(self, depth_mm: DepthImage, color: ColorImage) -> RgbdFrame:
        """Return the frame as the engine read it."""
        return RgbdFrame(
            index=self.index,
            device_index=self.device_index,
            missed_frames=self.missed_frames,
            timestamp_us=self.timestamp_us,
            color_timestamp_us=self.color_timestamp_us,
            received_ns=self.received_ns,
            queue_empty_ns=self.queue_empty_ns,
            depth_mm=depth_mm,
            color=color,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Raised:
    """An error that was raised instead of a reading."""

    name: str
    text: str

    def again(self) -> Exception:
        """Return an error of the same class and text; a TidegateError where it was one."""
        known: object = getattr(errors, self.name, None)
        kind = known if isinstance(known, type) and issubclass(known, errors.TidegateError) else None
        # Made without its constructor: the arguments are not on the tape.
        error: Exception = Exception.__new__(kind or type(self.name, (Exception,), {}))
        error.args = (self.text,)
        return error


def raised_of(error: Exception) -> Raised:
    """Return an error as it is stored."""
    return Raised(name=type(error).__name__, text=str(error))


def head_of(frame: RgbdFrame) -> FrameHead:
    """Return a frame without its pictures."""
    return FrameHead(
        index=frame.index,
        device_index=frame.device_index,
        missed_frames=frame.missed_frames,
        timestamp_us=frame.timestamp_us,
        color_timestamp_us=frame.color_timestamp_us,
        received_ns=frame.received_ns,
        queue_empty_ns=frame.queue_empty_ns,
    )


def kept_of(kind: InputKind, value: Any) -> Any:  # noqa: ANN401 - any reading
    """Return the part of a reading that goes onto the tape."""
    match kind:
        case InputKind.FRAME if value.frame is not None:
            return replace(value, frame=head_of(value.frame))
        case InputKind.TURN:
            return replace(value, commands=tuple(queued.command for queued in value.commands))
        case InputKind.LINE if value.error is not None:
            return replace(value, error=raised_of(value.error))
        case InputKind.TRAINED:
            return value is not None
    return value


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
