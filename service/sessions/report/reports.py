"""Makes the report of a stored session: its record, the figures of its samples, and what the audit says of it."""

import hashlib
import json
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session as DatabaseSession

from engine.core.files import PIECE_BYTES
from service.core.errors import SessionStateError
from service.core.schemas.reports import (
    ReportEvent,
    ReportFigures,
    ReportSignature,
    SessionReport,
    SignatureRequest,
    SignedDegree,
)
from service.core.schemas.sessions import Session
from service.sessions.records.sessions import session_answer
from service.sessions.report.figures import SampleColumns, read_columns, report_figures
from service.storage.audit.chain import Event
from service.storage.audit.log import AuditLog
from service.storage.database import queries
from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow, CalibrationRow, ModelRow, SessionRow
from service.storage.samples.service import SampleService
from service.storage.samples.store import SampleStore

ACTIONS = {
    "session.create": "created",
    "session.start": "started",
    "session.stop": "stopped",
    "session.close": "closed",
    "session.arm": "armed",
    "session.disarm": "disarmed",
    "session.hold": "held by hand",
    "session.release": "hold released",
    "session.acknowledge": "fault acknowledged",
    "session.reference": "reference set",
    "session.window": "window set",
    "session.baseline_correction": "window moved by the drift",
    "session.position_check": "position signed",
    "session.countersign": "countersigned",
    "session.signature": "report signed or noted",
    "model.retrain": "trained again",
    "model.activate": "stored model chosen",
    "model.apply": "new model taken up",
}
OVERRIDES = {
    "overrides_plan_gating": "another technique than the plan's",
    "repeats_fraction": "a fraction that was begun before",
    "overrides_contradiction": "a plan that a later file contradicts",
}
COUNTED = {
    "session.reference": ("the reference was set", 1),
    "session.window": ("the window was set", 0),
    "session.baseline_correction": ("the window was moved by the drift", 0),
    "session.hold": ("the beam was held by hand", 0),
}
"""Acts that are counted, and how many of them a usual session has."""
LOST_PERCENT = 1.0
OPEN = ("created", "running")
SIGNATURE = "session.signature"
REASONED = frozenset(
    {"session.arm", "session.reference", "session.window", "session.baseline_correction", "session.position_check"}
)
"""Acts whose reason says that a limit of the site was exceeded."""


@dataclass(frozen=True, slots=True, eq=False)
class StoredReport:
    """A session's report, and the samples that it was made from."""

    report: SessionReport
    columns: SampleColumns


class ReportService:
    """Makes reports of sessions that are over."""

    def __init__(self, database: Database, store: SampleStore) -> None:
        self._database, self._store = database, store
        self._log = AuditLog(database)
        self._signing = threading.Lock()

    def sign(self, session_id: str, request: SignatureRequest, actor: str) -> SessionReport:
        """Add a note or a signature to the audit; return the report with it.

        Raises
        ------
        SessionStateError
            The report is another one than the person looked at, or the person has signed it already.
        """
        detail = request.model_dump(exclude={"operator"})
        # One at a time: of two calls of one person at once, the second sees the first one's signature.
        with self._signing, self._log.refusals(actor=actor, action=SIGNATURE, session_id=session_id, detail=detail):
            present = self.of(session_id).report
            if request.samples_sha256 != present.samples_sha256:
                bound = "that of the report as it is now: read it again"
                msg = f"samples_sha256 must be {bound}"
                raise SessionStateError(msg, field="samples_sha256", value=request.samples_sha256, bound=bound)
            if request.is_signed and any(one.is_signed and one.name == actor for one in present.signatures):
                msg = f"{actor} has signed this report already: the second signature is another person's"
                raise SessionStateError(msg, field="operator", value=actor, bound="a person who has not signed")
            self._log.write(Event(actor=actor, action=SIGNATURE, session_id=session_id, detail=detail))
        return self.of(session_id).report

    def of(self, session_id: str) -> StoredReport:
        """Make the report of a session.

        Raises
        ------
        NotFoundError
            There is no such session.
        SessionStateError
            It is not over, or was never started: its figures would be of a part.
        SamplesRemovedError
            Its samples were removed.
        """
        with self._database.read() as db:
            row = queries.session_row(db, session_id)
            refuse_open(row)
            SampleService(self._database, self._store).refuse_removed(session_id, row.summary)
            session = session_answer(row)
            rows = list(_rows(db, session_id))
            calibration = db.scalar(select(CalibrationRow.sha256).where(CalibrationRow.id == row.calibration_id)) or ""
            newest = db.scalar(
                select(ModelRow).where(ModelRow.session_id == session_id).order_by(ModelRow.number.desc())
            )
            model = "" if newest is None else f"no. {newest.number}, {newest.components} components, {newest.sha256}"
        columns, counted = read_columns(self._store.batches(session_id))
        head = self._store.head(session_id)
        figures = report_figures(columns, counted, () if head is None else head.regions)
        report = SessionReport(
            session_id=session_id,
            session=session,
            figures=figures,
            events=list(_events(rows)),
            deviations=list(_deviations(session, figures, rows)),
            position=_position(rows),
            signatures=list(_signatures(rows)),
            signatures_needed=2 if _is_beyond(rows) else 1,
            model=model,
            software="" if head is None else head.software,
            samples_sha256=_sha256(self._store.parquet_path(session_id)),
            calibration_sha256=calibration,
            settings_sha256="" if head is None else head.settings_sha256,
        )
        return StoredReport(report, columns)


def refuse_open(row: SessionRow) -> None:
    """Raise SessionStateError for a session that is not over, or was never started."""
    if row.started_at is None or row.status in OPEN:
        msg = "a session can be reviewed once it was started and is over"
        raise SessionStateError(msg, field="session_id", value=row.status, bound="ended, stopped or interrupted")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Row:
    """A row of the audit, with its detail read."""

    at: str
    actor: str
    action: str
    outcome: str
    detail: dict[str, Any]

    @property
    def is_fault(self) -> bool:
        """Whether the gate went to a fault."""
        return self.action == queries.TRANSITION and self.detail.get("to_state") == "fault"


def _rows(db: DatabaseSession, session_id: str) -> Iterator[_Row]:
    query = select(AuditRow).where(AuditRow.session_id == session_id).order_by(AuditRow.sequence)
    for row in db.scalars(query):
        yield _Row(
            at=row.at, actor=row.actor, action=row.action, outcome=row.outcome, detail=json.loads(row.detail or "{}")
        )


def _events(rows: Sequence[_Row]) -> Iterator[ReportEvent]:
    for row in rows:
        if row.is_fault:
            text = f"fault: {str(row.detail.get('reason', '')).replace('_', ' ')}"
        elif row.action in ACTIONS and row.outcome != "requested":
            text = ACTIONS[row.action] if row.outcome == "done" else f"{ACTIONS[row.action]}: {row.outcome}"
        else:
            continue
        reasons = [row.detail.get("reason") if not row.is_fault else None, *_overridden(row)]
        said = "; ".join(str(one) for one in reasons if one)
        said_too = f"{text} ({said})" if said else text
        yield ReportEvent(at=datetime.fromisoformat(row.at), actor=row.actor, action=row.action, text=said_too)


def _overridden(row: _Row) -> list[str]:
    return [f"{what}: {row.detail[name]}" for name, what in OVERRIDES.items() if row.detail.get(name)]


def _deviations(session: Session, figures: ReportFigures, rows: Sequence[_Row]) -> Iterator[str]:
    """Say what a physicist has to look at."""
    if session.status in {"interrupted", "failed"}:
        yield f"the session was {session.status}: {session.status_detail or 'no cause is known'}"
    if session.is_simulated_beam:
        yield "the beam line was simulated"
    yield from filter(None, (session.calibration_warning, session.source_warning))
    done = [row for row in rows if row.outcome == "done"]
    for row in done:
        yield from _overridden(row)
    for action, (what, usual) in COUNTED.items():
        count = sum(row.action == action for row in done)
        if count > usual:
            yield f"{what} {count} times" if count > 1 else f"{what} once"
    faults = sum(row.is_fault for row in rows)
    if faults:
        yield f"{faults} fault{'' if faults == 1 else 's'}"
    yield from _missing(figures)


def _position(rows: Sequence[_Row]) -> list[SignedDegree]:
    """Return the degrees that were shown when the position was last signed."""
    signed = [row for row in rows if row.action == "session.position_check" and row.outcome == "done"]
    shown = signed[-1].detail.get("shown", {}) if signed else {}
    names = SignedDegree.model_fields
    return [SignedDegree(**{name: one[name] for name in names}) for one in shown.get("degrees", [])]


def _signatures(rows: Sequence[_Row]) -> Iterator[ReportSignature]:
    for row in rows:
        if row.action == SIGNATURE and row.outcome == "done":
            yield ReportSignature(at=datetime.fromisoformat(row.at), name=row.actor, **row.detail)


def _is_beyond(rows: Sequence[_Row]) -> bool:
    """Whether a person exceeded a limit of the site with a reason, or overrode a plan."""
    done = [row for row in rows if row.outcome == "done"]
    return any((row.action in REASONED and row.detail.get("reason")) or _overridden(row) for row in done)


def _missing(figures: ReportFigures) -> Iterator[str]:
    lost_percent = 100.0 * figures.lost / max(figures.frames, 1)
    if lost_percent > LOST_PERCENT:
        yield f"{lost_percent:.1f} % of the frames were not measured"
    if figures.missed_frames:
        yield f"{figures.missed_frames} frames of the camera never came"


def _sha256(path: Path) -> str:
    """Hash a file; empty where there is none."""
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while piece := file.read(PIECE_BYTES):
                digest.update(piece)
    except FileNotFoundError:
        return ""
    return digest.hexdigest()
