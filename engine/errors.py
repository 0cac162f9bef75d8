"""Every error the engine raises on purpose.

An error is for a broken device, a bad input or a bug. "Cannot tell" is not an error: it is data with a reason
(:class:`engine.frames.Lost`). Each class carries a stable ``code`` that the outside may rely on.
"""

from typing import ClassVar


class TidegateError(Exception):
    """Base of all errors raised on purpose."""

    code: ClassVar[str] = "tidegate_error"


class InvalidValueError(TidegateError):
    """A value from outside is out of its bound; names the field, the value and the bound."""

    code = "invalid_value"

    def __init__(self, field: str, value: object, bound: str) -> None:
        self.field = field
        self.value = _short(repr(value))
        self.bound = bound
        super().__init__(f"{field} is {self.value}: must be {bound}")


class CalibrationError(InvalidValueError):
    """A camera calibration that cannot be true."""

    code = "calibration_invalid"


class RecordingError(TidegateError):
    """A file that is no recording, or one that is damaged; the message is one line for a person."""

    code = "recording_unreadable"


class SourceLostError(TidegateError):
    """The camera is gone and will not come back by itself."""

    code = "source_lost"


class SourceEndedError(TidegateError):
    """A recording has been read to its last frame."""

    code = "source_ended"


class FrameTimeoutError(TidegateError):
    """No frame came in time; the source may still be usable."""

    code = "frame_timeout"


class SourceAwayError(FrameTimeoutError):
    """The camera is gone and is looked for; the source is still usable, and says so until it is back."""

    code = "source_lost"


class RuntimeMissingError(TidegateError):
    """The OpenNI2 runtime library is not on this machine."""

    code = "openni_missing"


class ModelError(TidegateError):
    """A motion model that cannot be learned, read or used here."""

    code = "model_invalid"


class ModelMismatchError(ModelError):
    """A motion model of another patient, of another calibration, or too far from the patient on the couch."""

    code = "model_mismatch"

    def __init__(self, field: str, value: object, bound: str, advice: str = "") -> None:
        self.field, self.value, self.bound = field, _short(value), bound
        super().__init__(_sentence(self.field, self.value, bound, advice))


class TrainingRefusedError(ModelError):
    """A training set, or a model learned from it, that teaches nothing; says what to do about it."""

    code = "training_refused"

    def __init__(self, field: str, value: object, bound: str, advice: str) -> None:
        self.field, self.value, self.bound = field, _short(value), bound
        super().__init__(_sentence(self.field, self.value, bound, advice))


class BeamLineError(TidegateError):
    """The beam line did not answer, or not as told."""

    code = "beam_line_failed"


class BeamLineMismatchError(BeamLineError):
    """The beam line reads back otherwise than it was told."""

    code = "beam_line_mismatch"


class CommandRefusedError(TidegateError):
    """The engine will not do that now; the message says why and what would help."""

    code = "command_refused"


def _short(value: object) -> str:
    shown = str(value)
    return shown if len(shown) <= 80 else f"{shown[:77]}..."


def _sentence(field: str, value: str, bound: str, advice: str) -> str:
    return f"{field} is {value}: must be {bound}" + (f"; {advice}" if advice else "")
