"""What stands at the head of a tape: all that an engine was made of, so that the same one can be made again."""

import platform
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from engine import __version__
from engine.calibration import Calibration, parse_calibration
from engine.errors import InvalidValueError, RecordingError
from engine.limits import GateLimits
from engine.model import MotionModel
from engine.pipeline import PipelineSettings
from engine.replaying.spelling import Spelling

RAW = "raw"
RECORDING = "recording"


@dataclass(frozen=True, slots=True, kw_only=True)
class Frames:
    """Where a session's frames lie: in the recording that was played, in a raw recording, or nowhere (None)."""

    kind: str | None
    path: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TapeHead:
    """What an engine was made of.

    Attributes
    ----------
    model
        The stored model it began with; None where it learned one.
    software, machine
        What it ran as, and on; the same numbers are promised for the same of both.
    """

    session_id: str
    limits: GateLimits
    measuring: PipelineSettings
    calibration: Calibration
    model: MotionModel | None
    frames: Frames
    software: str
    machine: dict[str, str]

    def spelled(self, spelling: Spelling) -> dict[str, Any]:
        """Put it into a tape's words."""
        return {
            "session_id": self.session_id,
            "limits": spelling.spell(self.limits),
            "measuring": spelling.spell(self.measuring),
            "calibration": self.calibration.to_json(),
            "model": spelling.spell(self.model),
            "frames": {"kind": self.frames.kind, "path": None if self.frames.path is None else str(self.frames.path)},
            "software": self.software,
            "machine": self.machine,
        }


def read_head(words: dict[str, Any], spelling: Spelling) -> TapeHead:
    """Read the head of a tape; raise RecordingError where it is damaged."""
    try:
        frames = words["frames"]
        return TapeHead(
            session_id=words["session_id"],
            limits=spelling.read(words["limits"]),
            measuring=spelling.read(words["measuring"]),
            calibration=parse_calibration(words["calibration"].encode()),
            model=spelling.read(words["model"]),
            frames=Frames(kind=frames["kind"], path=None if frames["path"] is None else Path(frames["path"])),
            software=words["software"],
            machine=words["machine"],
        )
    except (KeyError, TypeError, AttributeError, InvalidValueError) as error:
        msg = f"the tape's head is damaged: {type(error).__name__}"
        raise RecordingError(msg) from error


def this_software() -> str:
    """Name this version."""
    return f"tidegate {__version__}"


def this_machine() -> dict[str, str]:
    """Name what numbers may hang on besides the version."""
    return {
        "processor": _processor(),
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "opencv": version("opencv-python-headless"),
        "scipy": version("scipy"),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
