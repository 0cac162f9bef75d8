"""Run one fraction: prepare and deliver it over as many sessions as necessary, then fetch and check the records."""

import csv
import time
from collections.abc import Callable, Iterable, Set
from dataclasses import dataclass
from pathlib import Path

from lab.simulated_tps.delivery import BEAM_ON, BeamClock, DeliveredBeams, Recorded, recorded
from lab.simulated_tps.prescription import FractionEndedError, Prescription, SessionOverError, TpsError
from lab.simulated_tps.report import FractionReport, SessionReport
from lab.simulated_tps.session_driver import (
    DeliverySettings,
    FractionEvents,
    HeadSide,
    Progress,
    SessionDriver,
)
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

MAX_DIFFERENCE_S = 0.1
"""Largest difference of beam-on time besides gaps: each beam edge lies between two frames."""

MIN_SEEN = 0.75
"""Least share of the recorded frames, up to the last live frame, that must have been received live."""

MIN_SEEN_WITH_BEAM = 0.5
"""The same for frames with beam; lower, because one slow read can fall into a short beam."""

MAX_HOLD_DELAY_S, MAX_STOP_DELAY_S = 1.0, 5.0
"""Longest time that the beam and the recording may continue after the last live frame, while calls are repeated."""

LOST_IN_A_KILL_S = 1.0
FRAME_S = 1 / 30
STARTED = ("session.start",)
RESUMABLE = frozenset({"interrupted", "failed"})
MAX_SESSIONS = 5


# Compare the live stream of a session with the service's records: frames, beam-on time, transitions, audit.
def checked(
    session_id: str, clock: BeamClock, announced_missing: int, tps: TidegateClient, folder: Path
) -> SessionReport:
    """Fetch samples, transitions and audit of an ended session and compare them with the live frames in ``clock``."""
    session = tps.read_session(session_id)
    exported = tps.export_samples(session_id, folder / f"{session_id}.csv")
    with exported.path.open(newline="") as file:
        record = recorded(csv.DictReader(file))
    edges = sum(one["to_state"] == BEAM_ON for one in tps.transitions(session_id))
    actions = [row["action"] for row in tps.audit(session_id=session_id) if row["outcome"] == "done"]
    seen = set(clock.frames or ())
    unrecorded, missed = seen - record.frames, record.frames - seen
    troubles = [
        *_frame_troubles(record, session["summary"]["missed_frames"]),
        *_live_troubles(record, seen),
        *_time_troubles(clock, record, is_killed=session["status"] == "interrupted", unrecorded=len(unrecorded)),
        *([] if edges == record.rises else [f"the recorder shows {record.rises} beam rises, the transitions {edges}"]),
        *(f"the audit has no {action}" for action in STARTED if action not in actions),
        *([] if tps.verify_audit()["is_intact"] else ["the audit's hash chain is broken"]),
    ]
    return SessionReport(
        session_id=session_id,
        status=session["status"],
        live_frames=len(seen),
        recorded_frames=len(record.frames),
        missed_live=len(missed),
        told_missing=announced_missing,
        unrecorded=len(unrecorded),
        live_on_s=round(clock.on_s, 3),
        recorded_on_s=round(record.on_s, 3),
        unseen_s=round(clock.unseen_s, 3),
        beam_edges=edges,
        audit_rows=len(actions),
        troubles=tuple(troubles),
    )


def _frame_troubles(record: Recorded, missed_frames: int) -> Iterable[str]:
    if not record.frames:
        yield "no sample was recorded"
        return
    holes = max(record.frames) + 1 - len(record.frames)
    if holes > missed_frames:
        yield f"{holes} frames are not in the recorder, and the camera missed {missed_frames}"


def _live_troubles(record: Recorded, seen: set[int]) -> Iterable[str]:
    """Report a live stream that covers too little of the record for a meaningful comparison."""
    if not seen:
        yield "no live frame was received"
    elif record.frames and not record.frames & seen:
        yield f"no recorded sample was compared: none of the {len(record.frames)} was seen live"
    else:
        last = max(seen)
        yield from _share_trouble({frame for frame in record.frames if frame <= last}, seen, MIN_SEEN, "")
        yield from _share_trouble(record.on_frames, seen, MIN_SEEN_WITH_BEAM, " with beam")
        yield from _end_trouble(record.on_frames, last, MAX_HOLD_DELAY_S, "last beam")
        yield from _end_trouble(record.frames, last, MAX_STOP_DELAY_S, "record")


def _share_trouble(recorded: Set[int], seen: set[int], least: float, which: str) -> Iterable[str]:
    count = len(recorded & seen)
    if count < least * len(recorded):
        share = count / len(recorded)
        share_text = f"{count} of {len(recorded)} recorded frames{which} ({share:.0%})".replace("%", " %")
        yield f"the live stream showed {share_text}, and at least {100 * least:.0f} % are needed"


def _end_trouble(recorded: Set[int], last: int, latest_s: float, what: str) -> Iterable[str]:
    early_s = (max(recorded, default=last) - last) * FRAME_S
    if early_s > latest_s:
        yield f"the live stream ended {early_s:.1f} s before the {what}"


def _time_troubles(clock: BeamClock, record: Recorded, *, is_killed: bool, unrecorded: int) -> Iterable[str]:
    """Compare beam-on times; only a killed service may lose records, and at most its last second."""
    lost_s = LOST_IN_A_KILL_S if is_killed else 0.0
    difference_s = abs(clock.on_s - record.on_s)
    if difference_s > MAX_DIFFERENCE_S + clock.unseen_s + lost_s:
        yield f"beam-on time differs by {difference_s:.3f} s between the stream and the recorder"
    if unrecorded * FRAME_S > lost_s + FRAME_S:
        yield f"{unrecorded} frames were seen live and are not in the recorder"


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
