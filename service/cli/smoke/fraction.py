"""A simulated fraction as a check: only on a simulated beam line, from a recording of the service's own folders."""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from engine.core.errors import TidegateError
from service.cli.smoke.results import CheckResult, Outcome
from service.client import ClientError, PlanSessionRequest, PreparedSession, TidegateClient
from service.planning.simulated_tps.errors import TpsError

if TYPE_CHECKING:
    from service.planning.simulated_tps.report import FractionReport

NAME = "fraction"
UID = "1.2.826.0.1.3680043.8.498.3"
"""Each run imports a plan of its own below this root: a fraction is treated once."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FractionDemand:
    """The fraction to deliver: window [mm], beam-on time of each beam and longest wait for one [s]."""

    recording: str
    calibration: bytes
    therapist: str
    password: str
    lower_mm: float
    upper_mm: float
    beam_s: float
    patience_s: float


class SimulatedBeamClient(TidegateClient):
    """Prepares sessions on a simulated beam line only: elsewhere the recording could turn a real beam on."""

    def prepare_session(
        self, plan_id: str, request: PlanSessionRequest, *, idempotency_key: str | None = None
    ) -> PreparedSession:
        """Prepare a session; one with a real beam line is ended before it begins.

        Raises
        ------
        TpsError
            The service drives a real beam line.
        """
        prepared = super().prepare_session(plan_id, request, idempotency_key=idempotency_key)
        if not prepared["is_simulated_beam"]:
            self.stop(prepared["id"])
            message = "the service drives a real beam line: a simulated fraction is for a simulated one"
            raise TpsError(message)
        return prepared


def check_fraction(tps: SimulatedBeamClient, therapist: TidegateClient, demand: FractionDemand) -> CheckResult:
    """Deliver a fraction of the built-in plan, and compare what was seen live with the record."""
    try:
        therapist.log_in(demand.therapist, demand.password)
        with tempfile.TemporaryDirectory(prefix="tidegate-smoke-") as folder:
            report = _deliver(tps, therapist, demand, Path(folder))
    except (TidegateError, ClientError, OSError) as error:
        return CheckResult(check=NAME, outcome=Outcome.FAILED, detail=str(error))
    figures: dict[str, object] = {
        "seconds": report.seconds,
        "delivered_s": round(sum(one.delivered_s for one in report.beams), 2),
        "frames": sum(one.live_frames for one in report.stretches),
        "holds": report.holds,
    }
    if not report.is_good:
        detail = "; ".join(dict.fromkeys((report.outcome, *report.all_troubles)))
        return CheckResult(check=NAME, outcome=Outcome.FAILED, detail=detail, figures=figures)
    detail = f"{len(report.beams)} beams in {report.seconds:.0f} s, {figures['frames']} frames, recorded"
    return CheckResult(check=NAME, outcome=Outcome.OK, detail=detail, figures=figures)


def _deliver(
    tps: SimulatedBeamClient, therapist: TidegateClient, demand: FractionDemand, folder: Path
) -> "FractionReport":
    from service.planning.simulated_tps.fraction import FractionRun, FractionSettings
    from service.planning.simulated_tps.prescription import built_in_plan, prescription_of
    from service.planning.simulated_tps.session_driver import DeliverySettings

    plan = tps.import_plan(built_in_plan(uid=f"{UID}.{time.time_ns()}"))
    calibration_id = tps.upload_calibration(demand.calibration)["id"]
    settings = FractionSettings(
        source={"kind": "recording", "path": demand.recording, "player": "reader"},
        calibration_id=calibration_id,
        window={"signal": "whole", "lower_mm": demand.lower_mm, "upper_mm": demand.upper_mm},
        delivery=DeliverySettings(beam_timeout_s=demand.patience_s),
    )
    run = FractionRun(
        number=1,
        prescription=prescription_of(plan, beam_s=demand.beam_s),
        settings=settings,
        tps=tps,
        therapist=therapist,
        folder=folder,
        on_progress=lambda _: None,
    )
    return run.run()
