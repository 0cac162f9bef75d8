"""Run one fraction: prepare and deliver it over as many sessions as necessary, then fetch and check the records."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from service.client import (
    DeviceSource,
    PlanSessionRequest,
    PreparedSession,
    ProblemError,
    RecordingSource,
    TidegateClient,
    UnreachableError,
    Window,
)
from service.planning.simulated_tps.checks import checked
from service.planning.simulated_tps.delivered_beams import DeliveredBeams
from service.planning.simulated_tps.errors import FractionEndedError, SessionOverError, TpsError
from service.planning.simulated_tps.prescription import Prescription
from service.planning.simulated_tps.report import FractionReport
from service.planning.simulated_tps.session_driver import (
    DeliverySettings,
    FractionEvents,
    HeadSide,
    Progress,
    SessionDriver,
)

RESUMABLE = frozenset({"interrupted", "failed"})
MAX_SESSIONS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class FractionSettings:
    """Settings of a fraction that the plan does not contain."""

    source: RecordingSource | DeviceSource
    calibration_id: str
    window: Window
    delivery: DeliverySettings
    head_direction: HeadSide | None = None


class FractionRun:
    """Runs one fraction of a plan."""

    def __init__(
        self,
        *,
        number: int,
        prescription: Prescription,
        settings: FractionSettings,
        tps: TidegateClient,
        therapist: TidegateClient | None,
        folder: Path,
        on_progress: Callable[[Progress], None],
    ) -> None:
        self._number = number
        self._prescription = prescription
        self._settings = settings
        self._tps = tps
        self._therapist = therapist
        self._folder = folder
        self._on_progress = on_progress
        self._delivered = DeliveredBeams(prescription.beams)
        self._events = FractionEvents()
        self._sessions: list[SessionDriver] = []

    def run(self) -> FractionReport:
        """Deliver the fraction as far as possible and check the records of its sessions."""
        began_s = time.monotonic()
        try:
            outcome = self._deliver()
        except (TpsError, ProblemError, UnreachableError) as error:
            outcome = f"ended: {error}"
        reports = [
            checked(one.session_id, one.clock, one.announced_missing, self._tps, self._folder) for one in self._sessions
        ]
        return FractionReport(
            number=self._number,
            outcome=outcome,
            seconds=round(time.monotonic() - began_s, 1),
            beams=self._delivered.reports(),
            stretches=tuple(reports),
            holds=dict(self._events.holds),
            faults=tuple(self._events.faults),
            acknowledged=self._events.acknowledged,
            lost_answers=self._events.lost_answers,
        )

    def _deliver(self) -> str:
        """Deliver the beams; continue in a new session if the service interrupted the previous one."""
        for _ in range(MAX_SESSIONS):
            try:
                self._next_session().run()
            except SessionOverError as over:
                if self._delivered.is_done:
                    return "delivered"
                if over.status not in RESUMABLE:
                    raise FractionEndedError(str(over)) from over
            else:
                return "delivered"
        message = f"the service broke off {MAX_SESSIONS} sessions of this fraction"
        raise FractionEndedError(message)

    def _next_session(self) -> SessionDriver:
        session = self._prepared()
        driver = SessionDriver(
            session["id"],
            tps=self._tps,
            therapist=self._therapist,
            delivered=self._delivered,
            events=self._events,
            settings=self._settings.delivery,
            on_progress=self._on_progress,
            head_direction=session.get("head_direction"),
        )
        self._sessions.append(driver)
        return driver

    def _prepared(self) -> PreparedSession:
        """Prepare a session from the plan; only a person may repeat a fraction that was started before."""
        request: PlanSessionRequest = {
            "fraction_number": self._number,
            "source": self._settings.source,
            "calibration_id": self._settings.calibration_id,
            "window": self._settings.window,
        }
        if self._settings.head_direction is not None:
            request["head_direction"] = self._settings.head_direction
        if not self._sessions:
            return self._tps.prepare_session(self._prescription.plan_id, request)
        if self._therapist is None:
            message = "the session was broken off, and only a person may repeat its fraction"
            raise FractionEndedError(message)
        model = next(self._tps.session_models(self._sessions[-1].session_id), None)
        request["repeats_fraction"] = "broken off by a restart"
        request["model_id"] = None if model is None else model["id"]
        return self._therapist.prepare_session(self._prescription.plan_id, request)
