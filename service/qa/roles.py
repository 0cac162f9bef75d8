"""The role that builds QA jobs, and the files that it reads; tests use a fake."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from engine.calibration.camera_calibration import Calibration
from service.qa import schemas
from service.qa.jobs import QaJob


@dataclass(frozen=True, slots=True, kw_only=True)
class QaFiles:
    """Paths of the recordings and the trace; None for a live camera and for an input that the run does not use."""

    plate: Path | None = None
    phantom: Path | None = None
    trace: Path | None = None


class QaRig(Protocol):
    """Builds QA jobs on cameras, recordings and the beam line."""

    def job(self, request: schemas.QaRunRequest, files: QaFiles, calibration: Calibration | None) -> QaJob:
        """Build the job of a run without opening anything; raise a TidegateError naming what cannot be used."""
