"""A whole fraction: prepared, delivered over as many sessions as it takes, fetched and checked."""

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
from service.tps.checks import checked
from service.tps.errors import FractionEndedError, SessionOverError, TpsError
from service.tps.ledger import Ledger
from service.tps.prescription import Prescription
from service.tps.report import FractionReport
from service.tps.stretch import Manner, Progress, Story, Stretch

RESUMABLE = frozenset({"interrupted", "failed"})
MOST_SESSIONS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Wishes:
    """What a plan does not say."""

    source: RecordingSource | DeviceSource
    calibration_id: str
    window: Window
    manner: Manner


class FractionRun:
    """Runs one fraction of a plan."""

    def __init__(
        self,
        *,
        number: int,
        prescription: Prescription,
        wishes: Wishes,
        tps: TidegateClient,
        therapist: TidegateClient | None,
        folder: Path,
        tell: Callable[[Progress], None],
    ) -> None:
        self._number = number
        self._prescription = prescription
        self._wishes = wishes
        self._tps = tps
        self._therapist = therapist
        self._folder = folder
        self._tell = tell
        self._ledger = Ledger(prescription.beams)
        self._story = Story()
        self._stretches: list[Stretch] = []

    def run(self) -> FractionReport:
        """Deliver the fraction, or as much of it as can be, and check what was kept of it."""
        began_s = time.monotonic()
        try:
            outcome = self._deliver()
        except (TpsError, ProblemError, UnreachableError) as error:
            outcome = f"ended: {error}"
        reports = [
            checked(one.session_id, one.clock, one.told_missing, self._tps, self._folder) for one in self._stretches
        ]
        return FractionReport(
            number=self._number,
            outcome=outcome,
            seconds=round(time.monotonic() - began_s, 1),
            beams=self._ledger.reports(),
            stretches=tuple(reports),
            holds=dict(self._story.holds),
            faults=tuple(self._story.faults),
            acknowledged=self._story.acknowledged,
            lost_answers=self._story.lost_answers,
        )

    def _deliver(self) -> str:
        """Go on in a new session for as long as the service breaks off the one before."""
        for _ in range(MOST_SESSIONS):
            try:
                self._stretch().run()
            except SessionOverError as over:
                if self._ledger.is_done:
                    return "delivered"
                if over.status not in RESUMABLE:
                    raise FractionEndedError(str(over)) from over
            else:
                return "delivered"
        message = f"the service broke off {MOST_SESSIONS} sessions of this fraction"
        raise FractionEndedError(message)

    def _stretch(self) -> Stretch:
        session = self._prepared()
        stretch = Stretch(
            session["id"],
            tps=self._tps,
            therapist=self._therapist,
            ledger=self._ledger,
            story=self._story,
            manner=self._wishes.manner,
            tell=self._tell,
        )
        self._stretches.append(stretch)
        return stretch

    def _prepared(self) -> PreparedSession:
        """Prepare a session from the plan; what was begun before, a person has to want again."""
        request: PlanSessionRequest = {
            "fraction_number": self._number,
            "source": self._wishes.source,
            "calibration_id": self._wishes.calibration_id,
            "window": self._wishes.window,
        }
        if not self._stretches:
            return self._tps.prepare_session(self._prescription.plan_id, request)
        if self._therapist is None:
            message = "the session was broken off, and only a person may have its fraction begun again"
            raise FractionEndedError(message)
        model = next(self._tps.session_models(self._stretches[-1].session_id), None)
        request["repeats_fraction"] = "broken off by a restart"
        request["model_id"] = None if model is None else model["id"]
        return self._therapist.prepare_session(self._prescription.plan_id, request)
