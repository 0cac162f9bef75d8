"""Virtual set-ups for demonstration, which the command line hands to the service: a clinical one has none."""

from dataclasses import replace

from engine.calibration import Calibration
from engine.qa import QaKind
from service.core.settings.settings import Settings
from service.qa.jobs import QaFiles, QaJob
from service.qa.late_rig import LateRig
from service.qa.schemas import QaRunRequest, QaSimulation


class SimulatingRig:
    """A :class:`service.qa.jobs.QaRig` that also builds jobs on a virtual set-up."""

    def __init__(self, settings: Settings) -> None:
        self._real = LateRig(settings)

    def job(self, request: QaRunRequest, files: QaFiles, calibration: Calibration | None) -> QaJob:
        """Build the job of a run; raise a TidegateError naming what cannot be used."""
        if request.simulation is None:
            return self._real.job(request, files, calibration)
        return virtual_job(QaKind(request.kind), request.simulation)


def virtual_job(kind: QaKind, simulation: QaSimulation) -> QaJob:
    """Build a virtual job with a beam line in memory; the site's beam line is not used."""
    from engine.lab.virtual_qa import VIRTUAL_BASELINE, RigFaults, virtual_inputs
    from service.qa.guarded_line import GuardedLine
    from service.qa.rig import EngineJob

    inputs = virtual_inputs(RigFaults(**simulation.faults.model_dump()), seed=simulation.seed)
    assert inputs.beam is not None, "a virtual set-up has a beam line"
    line = GuardedLine(inputs.beam.line)
    guarded = replace(inputs, beam=replace(inputs.beam, line=line))
    return EngineJob(kind, guarded, line, own_baseline=VIRTUAL_BASELINE)
