"""Values of the engine as JSON and back, to the last bit: the words of a tape.

Only what stands in the table can be spelled or read, so that a tape can make nothing but values. Python's own JSON
writes a float in as many digits as tell it from every other.
"""

import dataclasses
import enum
from collections.abc import Callable
from typing import Any

from engine.breath import BreathEventKind, GateSignal, SignalChoice
from engine.capture.source import SourceDescription
from engine.commands import (
    Acknowledge,
    ActivateModel,
    ApplyModel,
    Arm,
    CorrectBaseline,
    Disarm,
    HoldBeam,
    ReleaseBeam,
    Retrain,
    SetReference,
)
from engine.errors import InvalidValueError, ModelError, RecordingError
from engine.likeness import LikenessLimits
from engine.limits import GateLimits
from engine.model import MotionModel
from engine.permits import GateState, HoldReason
from engine.pipeline import PipelineSettings
from engine.polygons import NamedRegion
from engine.replaying.heard import FrameHead, Raised
from engine.stages.gate import Interruption
from engine.training import TrainingSettings
from engine.windows import AmplitudeWindow, BreathHoldWindow, HoldKind, Join, JoinedWindow, PhaseWindow, Unit

_NO_WORDS = (LookupError, TypeError, ValueError, AttributeError, RecursionError, InvalidValueError, ModelError)
_CLASSES: dict[str, type] = {
    known.__name__: known
    for known in (
        *(Acknowledge, ActivateModel, ApplyModel, Arm, CorrectBaseline, Disarm, HoldBeam, ReleaseBeam, Retrain),
        *(SetReference, GateLimits, AmplitudeWindow, BreathHoldWindow, JoinedWindow, PhaseWindow, SignalChoice),
        *(PipelineSettings, TrainingSettings, LikenessLimits, NamedRegion, SourceDescription, Interruption),
        *(FrameHead, Raised),
    )
}
_ENUMS: dict[str, type[enum.Enum]] = {
    known.__name__: known for known in (BreathEventKind, GateSignal, GateState, HoldReason, HoldKind, Join, Unit)
}


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Spelling:
    """How values are spelled; motion models by the name that ``name_of`` gives them and ``model_of`` finds them by."""

    name_of: Callable[[MotionModel], str]
    model_of: Callable[[str], MotionModel]

    def spell(self, value: Any) -> Any:  # noqa: ANN401 - any of the table's values, as any of JSON's
        """Put a value into JSON's words."""
        if isinstance(value, enum.Enum):
            return {"e": [type(value).__name__, value.value]}
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if isinstance(value, list | tuple):
            return {"l" if isinstance(value, list) else "t": [self.spell(one) for one in value]}
        if isinstance(value, frozenset):
            return {"s": sorted((self.spell(one) for one in value), key=str)}
        if isinstance(value, MotionModel):
            return {"m": self.name_of(value)}
        name = type(value).__name__
        if _CLASSES.get(name) is not type(value):
            msg = f"a {name} has no place on a tape"
            raise TypeError(msg)
        names = [one.name for one in dataclasses.fields(_CLASSES[name])]
        return {"d": [name, {one: self.spell(getattr(value, one)) for one in names}]}

    def read(self, words: Any) -> Any:  # noqa: ANN401
        """Return the value; raise RecordingError where these words spell none."""
        if not isinstance(words, dict):
            return words
        try:
            ((kind, body),) = words.items()
            return self._made(kind, body)
        except (
            LookupError,
            TypeError,
            ValueError,
            AttributeError,
            RecursionError,
            InvalidValueError,
            ModelError,
        ) as error:
            msg = f"the tape is damaged: {type(error).__name__} in {str(words)[:60]}"
            raise RecordingError(msg) from error

    def _made(self, kind: str, body: Any) -> Any:  # noqa: ANN401
        match kind:
            case "e":
                return _ENUMS[body[0]](body[1])
            case "d":
                return _CLASSES[body[0]](**{name: self.read(words) for name, words in body[1].items()})
            case "m":
                return self.model_of(body)
        makers: dict[str, type] = {"l": list, "t": tuple, "s": frozenset}
        return makers[kind](self.read(one) for one in body)
