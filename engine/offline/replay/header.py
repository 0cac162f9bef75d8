"""The header of a tape: everything an engine was made of, so that a replay can make the same one."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine import __version__
from engine.calibration.camera_calibration import Calibration, parse_calibration
from engine.core.errors import InvalidValueError, RecordingError
from engine.core.fraction_arming import FractionArming, read_fraction_arming
from engine.core.motion_model import MotionModel
from engine.core.reference import FirstReference, read_first_reference
from engine.gating.limits import GateLimits
from engine.motion.settings import PipelineSettings
from engine.offline.replay.encoding import TapeEncoding

METHOD = 16
"""Number of the measuring method, increased with every change by which the same frames may be believed, measured or
gated otherwise: then an earlier session replays to other results on purpose."""

RAW = "raw"
RECORDING = "recording"


@dataclass(frozen=True, slots=True, kw_only=True)
class Frames:
    """Where a session's frames are: in the recording that was played, in a raw recording, or not kept (None)."""

    kind: str | None
    path: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TapeHeader:
    """Everything an engine was made of.

    Attributes
    ----------
    model
        The stored model it started with; None where it learned one.
    first_reference
        That of an earlier session of the same fraction; None where there was none.
    fraction_arming
        What earlier sessions of the fraction were armed with; None where it was not armed.
    plan_position
        The first reference of the plan's first fraction; None in that fraction.
    software, machine
        Version and processor. Equal bits are promised where both are the same; for others see
        :mod:`engine.offline.replay.comparison`.
    method
        Number of the method that measured it.
    """

    session_id: str
    limits: GateLimits
    measuring: PipelineSettings
    calibration: Calibration
    model: MotionModel | None
    first_reference: FirstReference | None = None
    plan_position: FirstReference | None = None
    fraction_arming: FractionArming | None = None
    frames: Frames
    software: str
    machine: dict[str, str]
    method: int = METHOD

    def encoded(self, encoding: TapeEncoding) -> dict[str, Any]:
        """Return the header encoded for a tape."""
        return {
            "session_id": self.session_id,
            "limits": encoding.encode(self.limits),
            "measuring": encoding.encode(self.measuring),
            "calibration": self.calibration.to_json(),
            "model": encoding.encode(self.model),
            "first_reference": None if self.first_reference is None else self.first_reference.to_json(),
            "plan_position": None if self.plan_position is None else self.plan_position.to_json(),
            "fraction_arming": None if self.fraction_arming is None else self.fraction_arming.to_json(),
            "frames": {"kind": self.frames.kind, "path": None if self.frames.path is None else str(self.frames.path)},
            "software": self.software,
            "machine": self.machine,
            "method": self.method,
        }


def read_head(encoded: dict[str, Any], encoding: TapeEncoding) -> TapeHeader:
    """Read the header of a tape; raise RecordingError where it is damaged."""
    try:
        frames = encoded["frames"]
        machine = encoded["machine"]
        if not isinstance(machine, dict):
            msg = "the tape's head is damaged: it names no machine"
            raise RecordingError(msg)
        method = encoded["method"]
        if isinstance(method, bool) or not isinstance(method, int) or method < 1:
            msg = f"the tape's head is damaged: its method is {method!r}"
            raise RecordingError(msg)
        first, position = encoded["first_reference"], encoded["plan_position"]
        arming = encoded.get("fraction_arming")  # tapes of before method 14 have none
        return TapeHeader(
            session_id=encoded["session_id"],
            limits=encoding.decode(encoded["limits"]),
            measuring=encoding.decode(encoded["measuring"]),
            calibration=parse_calibration(encoded["calibration"].encode()),
            model=encoding.decode(encoded["model"]),
            first_reference=None if first is None else read_first_reference(first),
            plan_position=None if position is None else read_first_reference(position),
            fraction_arming=None if arming is None else read_fraction_arming(arming),
            frames=Frames(kind=frames["kind"], path=None if frames["path"] is None else Path(frames["path"])),
            software=encoded["software"],
            machine=machine,
            method=method,
        )
    except (KeyError, TypeError, AttributeError, InvalidValueError) as error:
        msg = f"the tape's head is damaged: {type(error).__name__}"
        raise RecordingError(msg) from error


def this_software() -> str:
    """Return the name and version of this software."""
    return f"tidegate {__version__}"
