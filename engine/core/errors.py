"""Every error the engine raises on purpose.

An error is for a broken device, a bad input or a bug. An unknown value is not an error: it is data with a reason
(:class:`engine.core.frames.Lost`). Each class carries a stable ``code`` that the outside may rely on.
"""

import re
from typing import ClassVar


class TidegateError(Exception):
    """Base of all errors raised on purpose. The code of a class without one is its name's: QaStateError `qa_state`."""

    code: ClassVar[str] = "tidegate_error"

    def __init_subclass__(cls) -> None:
        """Give the class its code."""
        if cls.__name__.endswith("Error") and "code" not in cls.__dict__:
            cls.code = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", cls.__name__.removesuffix("Error")).lower()


class InvalidValueError(TidegateError):
    """A value is outside its bound; the error has the field, the value and the bound."""

    def __init__(self, field: str, value: object, bound: str) -> None:
        self.field = field
        self.value = _short(repr(value))
        self.bound = bound
        super().__init__(f"{field} is {self.value}: must be {bound}")


class CalibrationError(InvalidValueError):
    """The camera calibration is invalid or physically impossible."""

    code = "calibration_invalid"


class RecordingError(TidegateError):
    """The file is not a recording, or it is damaged; the message is one line for an operator."""

    code = "recording_unreadable"


class SourceLostError(TidegateError):
    """The camera is disconnected and does not reconnect by itself."""


class CameraMismatchError(SourceLostError):
    """The camera is not the one that was calibrated; the message has both serial numbers."""


class SourceEndedError(TidegateError):
    """A recording has been read to its last frame."""


class FrameTimeoutError(TidegateError):
    """No frame came in time; the source may still be usable."""


class SourceAwayError(FrameTimeoutError):
    """The camera is disconnected and the source searches for it; the source stays usable."""

    code = "source_lost"


class RuntimeMissingError(TidegateError):
    """The SDK of no camera is installed on this machine, or not the one that is needed."""

    code = "openni_missing"


class ModelError(TidegateError):
    """The motion model cannot be trained, read or used."""

    code = "model_invalid"


class ModelMismatchError(ModelError):
    """The motion model belongs to another patient or calibration, or does not match the patient on the couch."""

    def __init__(self, field: str, value: object, bound: str, advice: str = "") -> None:
        self.field, self.value, self.bound = field, _short(value), bound
        super().__init__(_sentence(self.field, self.value, bound, advice))


class TrainingRefusedError(ModelError):
    """The training frames, or the model learned from them, are not usable; the message has the remedy."""

    def __init__(self, field: str, value: object, bound: str, advice: str) -> None:
        self.field, self.value, self.bound = field, _short(value), bound
        super().__init__(_sentence(self.field, self.value, bound, advice))


class TrainingFailedError(ModelError):
    """The process of a training was killed, hung or failed: there is no new model, and the present one stays in use."""


class BeamLineError(TidegateError):
    """The beam line did not answer, or did not follow the command."""

    code = "beam_line_failed"


class BeamLineMismatchError(BeamLineError):
    """The beam line's read-back differs from the command."""


class LeaseLapsedError(BeamLineError):
    """The permit before had lapsed in the line: it is on again after a hold only."""

    code = BeamLineError.code


class CommandRefusedError(TidegateError):
    """The engine refuses the command in its present state; the message has the reason and the remedy."""


class HeadDirectionError(CommandRefusedError):
    """The window is on a part of the patient, and the head direction is missing, unconfirmed, or another one."""

    code = "head_direction_missing"


class ReferenceDistanceError(CommandRefusedError):
    """The reference, or the window with its correction, would lie beyond the budget from the fraction's first one."""

    def __init__(self, field: str, value: object, bound: str, advice: str) -> None:
        self.field, self.value, self.bound, self.advice = field, str(value), bound, advice
        super().__init__(_sentence(self.field, self.value, bound, advice))


class PositionUncheckedError(CommandRefusedError):
    """The patient's position was not compared with that of the plan and signed, or lies beyond the tolerance."""


class ReasonMissingError(CommandRefusedError):
    """The change needs a written reason of the person who makes it."""


class CountersignatureError(CommandRefusedError):
    """A second person has not countersigned the reference and the window that would be armed."""

    code = "countersignature_missing"


def _short(value: object) -> str:
    shown = str(value)
    return shown if len(shown) <= 80 else f"{shown[:77]}..."


def _sentence(field: str, value: str, bound: str, advice: str) -> str:
    return f"{field} is {value}: must be {bound}" + (f"; {advice}" if advice else "")
