"""The QA rig, loaded with its first run: fits and SciPy take 40 MB and a second, which no session needs."""

from engine.calibration import Calibration
from service.core.settings.settings import Settings
from service.qa.jobs import QaFiles, QaJob
from service.qa.schemas import QaRunRequest


class LateRig:
    """A :class:`service.qa.jobs.QaRig` that builds its jobs with :class:`service.qa.rig.EngineRig`."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def job(self, request: QaRunRequest, files: QaFiles, calibration: Calibration | None) -> QaJob:
        """Build the job of a run; raise a TidegateError naming what cannot be used."""
        from service.qa.rig import EngineRig

        return EngineRig(self._settings).job(request, files, calibration)
