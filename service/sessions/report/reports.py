"""Makes the report of a stored session: its record, the figures of its samples, and what the audit says of it."""

import hashlib
import json
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session as DatabaseSession

from engine.calibration import Calibration, parse_calibration
from engine.core.files import PIECE_BYTES
from service.core.errors import SessionStateError
from service.core.schemas.reports import (
    NoteRequest,
    ReportEvent,
    ReportFigures,
    ReportHead,
    ReportSignature,
    ReportWindow,
    SendRequest,
    SessionReport,
    SignatureRequest,
    SignedDegree,
)
from service.core.schemas.sessions import Session
from service.core.schemas.windows import Window
from service.core.settings.settings import Settings
from service.sessions.records.sessions import session_answer
from service.sessions.report.figures import SampleColumns, read_columns, report_figures
from service.sessions.report.window_words import window_text
from service.storage.audit.chain import Event, canonical_json, seal
from service.storage.audit.log import AuditLog
from service.storage.database import queries
from service.storage.database.engine import Database
from service.storage.database.queries import SIGNATURE
from service.storage.database.tables import (
    AuditRow,
    CalibrationRow,
    ModelRow,
    PlanRow,
    QaOutcomeRow,
    QaRunRow,
    SessionRow,
)
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
    "session.signature": "report signed",
    "session.note": "note added to the report",
    "model.reference_set": "reference taken up",
    "model.zero_needed": "reference needed again",
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
QA_LASTS = timedelta(hours=24)
UNMANNED = {"operator_lost", "service_silent"}
"""Hold reasons of an armed gate without a responsible person or service; each is a deviation."""
OPEN = ("created", "running")
NOTE, SEND = "session.note", "session.send"
REASONED = frozenset(
    {"session.arm", "session.reference", "session.window", "session.baseline_correction", "session.position_check"}
)
"""Acts whose reason says that a limit of the site was exceeded."""
HEAD = ("patient_reference", "plan_id", "fraction_id", "fraction_number", "operator", "calibration_id")
"""Of a session's record what the audit has too."""


@dataclass(frozen=True, slots=True, eq=False)
class StoredReport:
    """A session's report, and the samples that it was made from."""

    report: SessionReport
    columns: SampleColumns


class ReportService:
    """Makes reports of sessions that are over.

    Parameters
    ----------
    needs_two
        Whether the site asks for a second person: then two sign, and not both of them have armed.
    room, machine
        As the settings name them.
    """

    def __init__(
        self, database: Database, store: SampleStore, *, needs_two: bool = False, room: str = "", machine: str = ""
    ) -> None:
        self._database, self._store, self._needs_two = database, store, needs_two
        self._room, self._machine = room, machine
        self._log = AuditLog(database)
        self._signing = threading.Lock()

    def add_note(self, session_id: str, request: NoteRequest, actor: str) -> SessionReport:
        """Add a note to the audit; return the report with it. Raise SessionStateError where it is another report."""
        return self._written(session_id, NOTE, request.model_dump(exclude={"operator"}), actor)

    def sign(self, session_id: str, request: SignatureRequest, actor: str, *, confirmed_by: str) -> SessionReport:
        """Add a signature to the audit, confirmed by ``password`` or ``login``; return the report with it.

        SessionStateError: it is another report than the person looked at, or the person has signed it already.
        """
        detail = request.model_dump(exclude={"operator", "password"}) | {"confirmed_by": confirmed_by}
        return self._written(session_id, SIGNATURE, detail, actor)

    def accept(self, session_id: str, request: SendRequest, actor: str, pacs: str) -> None:
        """Note in the audit that a person sends the report that they looked at.

        Raises
        ------
        SessionStateError
            It is another report by now, or the site names no PACS.
        """
        with self._log.refusals(actor=actor, action=SEND, session_id=session_id, detail={"pacs": pacs}):
            present = self.of(session_id).report
            if not pacs:
                msg = "the site names no PACS: exchange.pacs"
                raise SessionStateError(msg, field="exchange.pacs", value="not set", bound="TITLE@host:port")
            self._refuse_other(present, request.content_sha256)
        detail = {"pacs": pacs, "content_sha256": request.content_sha256}
        self._log.write(Event(actor=actor, action=SEND, session_id=session_id, detail=detail))

    @staticmethod
    def _refuse_other(present: SessionReport, content_sha256: str) -> None:
        if content_sha256 != present.content_sha256:
            bound = "that of the report as it is now: read it again"
            msg = f"content_sha256 must be {bound}"
            raise SessionStateError(msg, field="content_sha256", value=content_sha256, bound=bound)

    def _written(self, session_id: str, action: str, detail: dict[str, Any], actor: str) -> SessionReport:
        # One at a time: of two calls of one person at once, the second sees the first one's signature.
        with self._signing, self._log.refusals(actor=actor, action=action, session_id=session_id, detail=detail):
            present = self.of(session_id).report
            self._refuse_other(present, detail["content_sha256"])
            if action == SIGNATURE:
                _refuse_signer(present, actor)
            self._log.write(Event(actor=actor, action=action, session_id=session_id, detail=detail))
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
            created = _created(rows)
            session, differs = _as_audited(session, rows)
            calibration = db.get(CalibrationRow, row.calibration_id)
            plan = None if row.rt_plan_id is None else db.get(PlanRow, row.rt_plan_id)
            qa = _qa_before(db, row.started_at)
            newest = db.scalar(
                select(ModelRow).where(ModelRow.session_id == session_id).order_by(ModelRow.number.desc())
            )
            model = "" if newest is None else f"no. {newest.number}, {newest.components} components, {newest.sha256}"
        columns, counted = read_columns(self._store.batches(session_id))
        head = self._store.head(session_id)
        figures = report_figures(columns, counted, () if head is None else head.regions)
        named = None if calibration is None else parse_calibration(calibration.document.encode())
        report = SessionReport(
            session_id=session_id,
            head=ReportHead(
                room=str(created.get("room", self._room)),
                machine=str(created.get("machine", self._machine)),
                armed_by=list(dict.fromkeys(one.actor for one in rows if _is_done(one, "session.arm"))),
                plan_label="" if plan is None else plan.label,
                plan_uid="" if plan is None else plan.sop_instance_uid,
                camera=_camera(named, created.get("plug_ins")),
                calibrated_at=None if calibration is None else calibration.created_at,
                qa=qa,
                first_sample_at=None
                if head is None or not len(columns.decided_ns)
                else head.at(int(columns.decided_ns[0])),
            ),
            session=session,
            differs=differs,
            windows=list(_windows(session, rows)),
            figures=figures,
            events=list(_events(rows)),
            deviations=list(_deviations(session, figures, rows)),
            position=_position(rows),
            signatures=[],
            signatures_needed=2 if self._needs_two or _is_beyond(rows) else 1,
            model=model,
            software="" if head is None else head.software,
            content_sha256="",
            samples_sha256=_sha256(self._store.parquet_path(session_id)),
            calibration_sha256="" if calibration is None else calibration.sha256,
            settings_sha256="" if head is None else head.settings_sha256,
        )
        return StoredReport(_signed(report, rows, covers_head="machine" in created), columns)


def report_service(database: Database, store: SampleStore, settings: Settings) -> ReportService:
    """Make the service as the settings have it."""
    two, machine = settings.needs_countersignature, settings.machine_name
    return ReportService(database, store, needs_two=two, room=settings.room, machine=machine)


def _qa_before(db: DatabaseSession, started_at: datetime | None) -> str:
    """Return the verdict of the newest daily QA run in the 24 hours before a session's start; empty without one."""
    if started_at is None:
        return ""
    query = select(QaRunRow, QaOutcomeRow).join(QaOutcomeRow).order_by(QaOutcomeRow.ended_at.desc())
    of_day = QaOutcomeRow.ended_at.between(started_at - QA_LASTS, started_at)
    found = db.execute(query.where(QaRunRow.kind == "daily", QaOutcomeRow.verdict.is_not(None), of_day)).first()
    return "" if found is None else f"{found[1].verdict}, {found[1].ended_at:%Y-%m-%d %H:%M} UTC, {found[0].operator}"


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
    is_sealed: bool = True

    @property
    def is_fault(self) -> bool:
        """Whether the gate went to a fault."""
        return self.action == queries.TRANSITION and self.detail.get("to_state") == "fault"


def _rows(db: DatabaseSession, session_id: str) -> Iterator[_Row]:
    query = select(AuditRow).where(AuditRow.session_id == session_id).order_by(AuditRow.sequence)
    for row in db.scalars(query):
        yield _Row(
            at=row.at,
            actor=row.actor,
            action=row.action,
            outcome=row.outcome,
            detail=json.loads(row.detail or "{}"),
            is_sealed=seal(row) == row.hash,
        )


def _camera(named: Calibration | None, plug_ins: object) -> str:
    """Return the calibrated camera, and what was no part of Tidegate at the session's creation."""
    words = [] if named is None else [named.camera, named.serial]
    if isinstance(plug_ins, list):
        words.append(f"(plug-ins: {', '.join(map(str, plug_ins))})")
    return " ".join(filter(None, words))


def _created(rows: Sequence[_Row]) -> dict[str, Any]:
    """Return how the session was created; empty where the audit does not have it."""
    return next((row.detail for row in rows if _is_done(row, "session.create")), {})


def _as_audited(session: Session, rows: Sequence[_Row]) -> tuple[Session, list[str]]:
    """Return the session as the audit has it, and what the database states otherwise: its row can be changed."""
    differs = [] if all(row.is_sealed for row in rows) else ["a row of the audit was changed: tidegate audit verify"]
    created = _created(rows)
    if not created:
        return session, [*differs, "the audit does not have how the session was created"]
    stated = {name: created[name] for name in HEAD if name in created}
    for name, value in stated.items():
        if getattr(session, name) != value:
            differs.append(f"the database states {name} {getattr(session, name)!r}, and the audit {value!r}")
    window = Window.model_validate(created["window"]) if "window" in created else session.window
    set_later = [row.detail["window"] for row in rows if _is_done(row, "session.window") and "window" in row.detail]
    newest = Window.model_validate(set_later[-1]) if set_later else window
    if session.window != newest:
        differs.append("the database states another window than the audit")
    return session.model_copy(update={**stated, "window": window}), differs


def _is_done(row: _Row, action: str) -> bool:
    return row.action == action and row.outcome == "done"


def _windows(session: Session, rows: Sequence[_Row]) -> Iterator[ReportWindow]:
    """Yield the prescribed window, then each one that was set or moved, with who and when."""
    edges: tuple[float, float] | None = None
    for row in rows:
        at, reason = datetime.fromisoformat(row.at), str(row.detail.get("reason") or "")
        if _is_done(row, "session.create"):
            text, edges = f"as prescribed: {window_text(session.window)}", _edges(session.window)
        elif _is_done(row, "session.window"):
            window = Window.model_validate(row.detail["window"])
            text, edges = f"set to {window_text(window)}", _edges(window)
        elif _is_done(row, "session.baseline_correction"):
            by = row.detail.get("by", 0.0)
            text, edges = f"moved by {by:+g}, with the drift", edges and (edges[0] + by, edges[1] + by)
        else:
            continue
        lower, upper = edges or (None, None)
        yield ReportWindow(at=at, actor=row.actor, text=text, reason=reason, lower=lower, upper=upper)


def _edges(window: Window) -> tuple[float, float] | None:
    """Return the edges of the first condition in mm or l; None of a phase, and in per cent of a breath."""
    pairs = ((window.lower_mm, window.upper_mm), (window.lower_l, window.upper_l))
    return next(((lower, upper) for lower, upper in pairs if lower is not None and upper is not None), None)


def _signed(report: SessionReport, rows: Sequence[_Row], *, covers_head: bool) -> SessionReport:
    """Return the report with the hash of its content, and the signatures compared with it.

    What reports did not have once is left out where they are of that time, so that they stay signed.
    """
    signing = {"signatures", "signatures_needed", "content_sha256", "events", "head"}
    content = report.model_dump(mode="json", exclude=signing)
    for one in content["windows"]:
        del one["lower"], one["upper"]
    del (
        content["figures"]["pulse_list"],
        content["session"]["signed_by"],
    )  # the samples' hash, and the signatures, have it
    if covers_head:
        content["head"] = {name: getattr(report.head, name) for name in ("room", "machine", "armed_by")}
    content["events"] = [one.model_dump(mode="json") for one in report.events if one.action not in {SIGNATURE, NOTE}]
    content_sha256 = hashlib.sha256(canonical_json(content).encode()).hexdigest()
    signatures = list(_signatures(rows, content_sha256))
    differs = [
        f"the content differs from what {one.name} signed at {one.at:%Y-%m-%d %H:%M:%S} UTC"
        for one in signatures
        if one.is_signed and not one.is_of_this
    ]
    return report.model_copy(
        update={
            "content_sha256": content_sha256,
            "signatures": signatures,
            "differs": [*differs, *report.differs],
        }
    )


def _refuse_signer(report: SessionReport, actor: str) -> None:
    """Refuse a second signature of one person, and of two signatures both by persons who have armed."""
    signed = {one.name for one in report.signatures if one.is_signed and one.is_of_this}
    if actor in signed:
        msg = f"{actor} has signed this report already: the second signature is another person's"
        raise SessionStateError(msg, field="operator", value=actor, bound="a person who has not signed")
    armed = {one.actor for one in report.events if one.action == "session.arm"}
    if report.signatures_needed > 1 and len(signed) == report.signatures_needed - 1 and {actor, *signed} <= armed:
        msg = f"{actor} has armed in this session, as who signed before: one of two persons has not"
        raise SessionStateError(msg, field="operator", value=actor, bound="a person who has not armed")


def _events(rows: Sequence[_Row]) -> Iterator[ReportEvent]:
    for row in rows:
        if row.is_fault:
            text = f"fault: {str(row.detail.get('reason', '')).replace('_', ' ')}"
        elif row.action in ACTIONS and row.outcome != "requested":
            act = ACTIONS[NOTE if row.action == SIGNATURE and not _signs(row) else row.action]
            text = act if row.outcome == "done" else f"{act}: {row.outcome}"
        else:
            continue
        reason = None if row.is_fault else row.detail.get("reason")
        reasons = [row.detail.get("meaning"), *_stated(row), reason, *_overridden(row)]
        said = "; ".join(str(one) for one in reasons if one)
        said_too = f"{text} ({said})" if said else text
        yield ReportEvent(at=datetime.fromisoformat(row.at), actor=row.actor, action=row.action, text=said_too)


def _stated(row: _Row) -> Iterator[str]:
    """Yield the figures of an act: the moment and the level of a reference, how far a window was moved."""
    if row.action == "session.reference" and "at" in row.detail:
        yield {"end_exhale": "end of exhale", "end_inhale": "end of inhale"}.get(row.detail["at"], "the present level")
        proposed = row.detail.get("proposed") or {}
        level = row.detail.get("level_seen", proposed.get("level"))
        if level is not None:
            yield f"level {level:+.2f} against the reference before"
        if row.detail.get("move_seen_mm") is not None:
            yield f"couch or camera moved by {row.detail['move_seen_mm']:.1f} mm"
    if row.action in {"model.reference_set", "model.zero_needed"}:
        yield str(row.detail.get("detail", ""))
    if row.action == "session.baseline_correction" and "by" in row.detail:
        yield f"by {row.detail['by']:+g}"


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
    yield from _unarmed(figures, rows)
    faults = sum(row.is_fault for row in rows)
    if faults:
        yield f"{faults} fault{'' if faults == 1 else 's'}"
    yield from _missing(figures)


def _unarmed(figures: ReportFigures, rows: Sequence[_Row]) -> Iterator[str]:
    """Yield the refused armings, and the holds without a responsible person or service."""
    refused = sum(row.action == "session.arm" and row.outcome == "refused" for row in rows)
    if refused:
        yield f"arming was refused {refused} time{'' if refused == 1 else 's'}"
    for one in figures.holds:
        if one.reason in UNMANNED:
            yield f"{one.text.lower()}: {one.count} hold{'' if one.count == 1 else 's'}, {one.seconds:.1f} s"


def _position(rows: Sequence[_Row]) -> list[SignedDegree]:
    """Return the degrees that were shown when the position was last signed."""
    signed = [row for row in rows if row.action == "session.position_check" and row.outcome == "done"]
    shown = signed[-1].detail.get("shown", {}) if signed else {}
    names = SignedDegree.model_fields
    return [SignedDegree(**{name: one[name] for name in names}) for one in shown.get("degrees", [])]


def _signatures(rows: Sequence[_Row], content_sha256: str) -> Iterator[ReportSignature]:
    for row in rows:
        if _is_done(row, SIGNATURE) or _is_done(row, NOTE):
            yield ReportSignature(
                at=datetime.fromisoformat(row.at),
                name=row.actor,
                is_signed=_signs(row),
                meaning=row.detail.get("meaning"),
                note=row.detail["note"],
                content_sha256=row.detail["content_sha256"],
                is_of_this=row.detail["content_sha256"] == content_sha256,
            )


def _signs(row: _Row) -> bool:
    """Whether a row signs: before notes had an action of their own, `is_signed` told them apart."""
    return row.action == SIGNATURE and bool(row.detail.get("is_signed", True))


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
