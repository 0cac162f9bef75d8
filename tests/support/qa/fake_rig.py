"""QA runs that do what a test tells them, on a beam line that can be looked at."""

import threading
from pathlib import Path

from engine.beam.simulated import SimulatedBeamLine
from engine.core.clock import NS_PER_MS, MonotonicClock
from engine.core.errors import BeamLineError, LeaseLapsedError, TidegateError
from engine.core.gate_state import HoldReason, Lease
from engine.qa.results import QaKind, QaNeed
from service.qa.guarded_line import GuardedLine
from tests.support.qa.sample_runs import BASELINE, report

PULSE_MS = 200


class FakeJob:
    """Permits the line again and again until it is let go, or until its line is taken away."""

    own_baseline = None

    def __init__(self, rig):
        self.clock = MonotonicClock()
        self.far = SimulatedBeamLine(self.clock)
        self.line = GuardedLine(self.far)
        self.rig = rig
        self.is_on = threading.Event()
        self.given = None

    def run(self, *, bounds, baseline, on_progress):
        self.given = (bounds, baseline)
        self.line.open()
        self.line.rearm()
        for sequence in range(10**6):
            on_progress(QaNeed.BEAM, sequence, None)
            if self.rig.go_on.wait(0.02):
                break
            self._pulse(sequence)
        if self.rig.fail_with is not None:
            raise self.rig.fail_with
        return self.rig.report

    def _pulse(self, sequence):
        now_ns = self.clock.now_ns()
        try:
            self.line.permit(Lease(granted_ns=now_ns, expires_ns=now_ns + PULSE_MS * NS_PER_MS, sequence=sequence))
        except LeaseLapsedError:  # this thread came late: the machine was busy
            self.line.hold(HoldReason.FRAME_LATE)
            return
        except BeamLineError:
            if not self.rig.is_stubborn:
                raise
            return  # as a drill does, which counts what a line refuses
        if self.far.is_on():
            self.is_on.set()


class FakeRig:
    """Makes fake runs; ``go_on`` lets them finish with ``report``."""

    def __init__(self):
        self.go_on = threading.Event()
        self.report = report(QaKind.DAILY, baseline=BASELINE)
        self.fail_with: TidegateError | None = None
        self.refuse_with: TidegateError | None = None
        self.is_stubborn = False
        self.jobs = []
        self.requests = []

    @property
    def job_now(self):
        return self.jobs[-1]

    def job(self, request, files, calibration):
        if self.refuse_with is not None:
            raise self.refuse_with
        self.requests.append((request, files, calibration))
        self.jobs.append(FakeJob(self))
        return self.jobs[-1]


def qa_files(folder: Path) -> None:
    """Put a plate, a phantom and its trace into an allowed folder; the fake rig reads none of them."""
    for name in ("plate.oni", "phantom.oni", "sine.csv"):
        (folder / name).write_bytes(b"not read by the fake rig")
