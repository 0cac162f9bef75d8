"""Virtual set-ups for demonstration: another distribution brings them, `tidegate-lab`; a clinical service uses none."""

from functools import cache
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Protocol

from engine.calibration import Calibration
from engine.qa import QaKind
from service.core.errors import BoundError
from service.core.settings.settings import Settings
from service.qa.jobs import QaFiles, QaJob
from service.qa.late_rig import LateRig
from service.qa.schemas import QaRunRequest, QaSimulation

if TYPE_CHECKING:  # loaded with the first measurement
    from service.qa.latency.rig import LatencyJob

GROUP = "tidegate.virtual_setups"
"""Entry points of this group name an object that is :class:`VirtualSetups`."""


class VirtualSetups(Protocol):
    """Builds jobs with a beam line in memory; the site's camera and beam line are not used."""

    def qa_job(self, kind: QaKind, simulation: QaSimulation) -> QaJob:
        """Build the job of a simulated QA run."""

    def latency_job(self, *, seed: int, seconds: float, delay_ms: float) -> "LatencyJob":
        """Build the job of a latency measurement on a virtual camera of known latency."""


class SimulatingRig:
    """A :class:`service.qa.jobs.QaRig` that also builds jobs on a virtual set-up, where one is installed."""

    def __init__(self, settings: Settings) -> None:
        self._real = LateRig(settings)

    def job(self, request: QaRunRequest, files: QaFiles, calibration: Calibration | None) -> QaJob:
        """Build the job of a run; raise a TidegateError naming what cannot be used."""
        if request.simulation is None:
            return self._real.job(request, files, calibration)
        return virtual_setups("simulation").qa_job(QaKind(request.kind), request.simulation)


def virtual_setups(field: str) -> VirtualSetups:
    """Return the installed virtual set-ups; raise BoundError naming ``field``, which asked for one, where none is."""
    found = _installed()
    if found is None:
        bound = "omitted: no virtual set-up is installed (pip install 'tidegate[lab]')"
        raise BoundError(f"{field} must be {bound}", field=field, value="given", bound=bound)
    return found


@cache
def _installed() -> VirtualSetups | None:
    loaded: list[VirtualSetups] = [found.load() for found in entry_points(group=GROUP)]
    return loaded[0] if loaded else None
