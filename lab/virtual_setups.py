"""The jobs of QA on virtual set-ups, which the service finds by the entry point ``tidegate.virtual_setups``."""

from dataclasses import replace

from engine.beam import SimulatedBeamLine
from engine.core.clock import MonotonicClock
from engine.qa import QaKind
from lab.virtual_latency import VirtualFaults, virtual_light
from lab.virtual_qa import VIRTUAL_BASELINE, RigFaults, virtual_inputs
from service.qa.guarded_line import GuardedLine
from service.qa.latency.rig import LatencyJob
from service.qa.rig import EngineJob
from service.qa.schemas import QaSimulation


class LabSetups:
    """A :class:`service.qa.virtual_setups.VirtualSetups`."""

    def qa_job(self, kind: QaKind, simulation: QaSimulation) -> EngineJob:
        """Build a QA job with a beam line in memory; the site's beam line is not used."""
        inputs = virtual_inputs(RigFaults(**simulation.faults.model_dump()), seed=simulation.seed)
        assert inputs.beam is not None, "a virtual set-up has a beam line"
        line = GuardedLine(inputs.beam.line)
        guarded = replace(inputs, beam=replace(inputs.beam, line=line))
        return EngineJob(kind, guarded, line, own_baseline=VIRTUAL_BASELINE)

    def latency_job(self, *, seed: int, seconds: float, delay_ms: float) -> LatencyJob:
        """Build a job on a virtual camera of known latency; the site's camera and beam line are not used."""
        given = virtual_light(VirtualFaults(delay_ms=delay_ms), seed=seed, seconds=seconds)
        # A cancel takes every job's line away, so this one has a line, too.
        return LatencyJob(given, GuardedLine(SimulatedBeamLine(MonotonicClock())))


SETUPS = LabSetups()
