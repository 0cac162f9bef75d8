"""Queries of the tables; each runs in the caller's session, so the caller decides on the transaction.

Retried writes that take effect once, even if a commit succeeded but its answer was lost.
"""

import json
from collections import Counter
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import NamedTuple, TypeVar

from sqlalchemy import JSON, ColumnElement, Select, Text, cast, func, literal, or_, select, tuple_, type_coerce
from sqlalchemy.orm import InstrumentedAttribute, Session

from service.core.errors import BoundError, NotFoundError
from service.core.list_filters import (
    ALL_ROWS,
    ALL_SESSIONS,
    ALL_TRANSITIONS,
    AuditFilter,
    SessionFilter,
    TransitionFilter,
)
from service.storage.database import identities
from service.storage.database.base import UtcTime, utc_text
from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow, CalibrationRow, ModelRow, PlanRow, QaRunRow, SessionRow

OPEN_STATUSES = ("created", "running")
BEAM_OFF = "beam.off"
TRANSITION = "gate.transition"
SIGNATURE = "session.signature"
HELD = ("hold", "fault")
FRACTION = ("patient_reference", "plan_id", "fraction_id")
RowT = TypeVar("RowT")
DatedT = TypeVar("DatedT", SessionRow, CalibrationRow, QaRunRow, PlanRow)
AUDIT_ORDER = (
    select(func.min(AuditRow.sequence))
    .where(AuditRow.session_id == SessionRow.id)
    .correlate(SessionRow)
    .scalar_subquery()
)
"""Which session was created first: by its first row in the audit, as the wall clock may have been set back."""
TRANSITION_DETAIL = type_coerce(cast(AuditRow.detail, Text().with_variant(JSON(), "postgresql")), JSON())
"""What a transition's row says, whose text is sealed, as JSON that the database reads."""
Seal = tuple[int, str]
_NEWEST = select(AuditRow.sequence, AuditRow.hash).order_by(AuditRow.sequence.desc()).limit(1)


def session_row(db: Session, session_id: str) -> SessionRow:
    """Return a session's row; raise NotFoundError if there is none."""
    row = db.get(SessionRow, session_id)
    if row is None:
        msg = "there is no such session"
        raise NotFoundError(msg, field="session_id", value=session_id)
    return row


def calibration_row(db: Session, calibration_id: str) -> CalibrationRow:
    """Return a calibration's row; raise NotFoundError if there is none."""
    row = db.get(CalibrationRow, calibration_id)
    if row is None:
        msg = "there is no such calibration"
        raise NotFoundError(msg, field="calibration_id", value=calibration_id)
    return row


def model_row(db: Session, model_id: str) -> ModelRow:
    """Return a model's row; raise NotFoundError if there is none."""
    row = db.get(ModelRow, model_id)
    if row is None:
        msg = "there is no such model"
        raise NotFoundError(msg, field="model_id", value=model_id)
    return row


class FractionStart(NamedTuple):
    """A session of a fraction, and its document: the first reference, or what it was armed with."""

    session_id: str
    document: str


def first_reference_of(db: Session, row: SessionRow) -> FractionStart | None:
    """Return the first reference of a session's fraction; None if no session of it had one.

    A fraction is a patient, a plan, and the fraction's name and number; a number that is left out is any.
    """
    document = SessionRow.first_reference
    query = select(SessionRow.id, document).where(*_same_fraction(row), document.is_not(None))
    found = db.execute(query.order_by(AUDIT_ORDER, SessionRow.created_at).limit(1)).first()
    return None if found is None else FractionStart(found[0], found[1] or "")


def fraction_arming_of(db: Session, row: SessionRow) -> FractionStart | None:
    """Return what a session's fraction was armed with last, of whichever session; None if it was not armed."""
    document = SessionRow.fraction_arming
    query = select(SessionRow.id, document).where(*_same_fraction(row), document.is_not(None))
    found = db.execute(query.order_by(AUDIT_ORDER.desc(), SessionRow.created_at.desc()).limit(1)).first()
    return None if found is None else FractionStart(found[0], found[1] or "")


def _same_fraction(row: SessionRow) -> list[ColumnElement[bool]]:
    """Return the condition that a session is of the same fraction; a number that is left out is any."""
    fraction: list[ColumnElement[bool]] = [getattr(SessionRow, name) == getattr(row, name) for name in FRACTION]
    if row.fraction_number is not None:
        number = SessionRow.fraction_number
        fraction.append(or_(number == row.fraction_number, number.is_(None)))
    return fraction


def plan_position_of(db: Session, row: SessionRow) -> FractionStart | None:
    """Return the position of a session's plan: the first reference of its first fraction; None in that fraction.

    The first fraction is that of the earliest session of this patient and plan with a confirmed reference. A fraction
    number that is left out is any, as in `first_reference_of`.
    """
    of_plan = [getattr(SessionRow, name) == getattr(row, name) for name in ("patient_reference", "plan_id")]
    columns = (SessionRow.id, SessionRow.first_reference, SessionRow.fraction_id, SessionRow.fraction_number)
    query = select(*columns).where(*of_plan, SessionRow.first_reference.is_not(None), SessionRow.id != row.id)
    found = db.execute(query.order_by(AUDIT_ORDER, SessionRow.created_at).limit(1)).first()
    if found is None:
        return None
    is_same_number = found[3] is None or row.fraction_number is None or found[3] == row.fraction_number
    is_first = found[2] == row.fraction_id and is_same_number
    return None if is_first else FractionStart(found[0], found[1] or "")


def simulation_of(db: Session, row: SessionRow) -> str | None:
    """Return the simulation day that was signed last for a session's plan, at this session or at an earlier one."""
    of_plan = [getattr(SessionRow, name) == getattr(row, name) for name in ("patient_reference", "plan_id")]
    query = select(SessionRow.simulation).where(
        *of_plan, SessionRow.simulation.is_not(None), SessionRow.created_at <= row.created_at
    )
    return db.scalar(query.order_by(SessionRow.created_at.desc()).limit(1))


def simulation_position_of(db: Session, row: SessionRow) -> FractionStart | None:
    """Return the confirmed reference of the session that is the plan's simulation day; None without one."""
    document = simulation_of(db, row)
    found = None if document is None else db.get(SessionRow, json.loads(document)["session_id"] or "")
    return None if found is None or found.first_reference is None else FractionStart(found.id, found.first_reference)


def open_session_id(db: Session) -> str | None:
    """Return the id of the session that is created or running; None if there is none."""
    return db.scalar(select(SessionRow.id).where(SessionRow.status.in_(OPEN_STATUSES)).limit(1))


def running_sessions(db: Session) -> Sequence[SessionRow]:
    """Return the sessions with status `running`."""
    return db.scalars(select(SessionRow).where(SessionRow.status == "running")).all()


def containing(text: str | None, *columns: InstrumentedAttribute[str]) -> list[ColumnElement[bool]]:
    """Return the condition that one of the columns contains the text, in any case of its letters; none without one."""
    return [] if text is None else [or_(*(column.icontains(text, autoescape=True) for column in columns))]


def session_page(
    db: Session, cursor: str | None, limit: int, filters: SessionFilter = ALL_SESSIONS
) -> tuple[Sequence[SessionRow], str | None]:
    """Return a page of sessions, newest first, and the next cursor; raise BoundError for an invalid cursor."""
    named = {name: getattr(filters, name) for name in ("status", "patient_reference", "plan_id")}
    if filters.patient_reference is not None:
        spelling = identities.stored(db, filters.patient_reference, filters.plan_id or "")
        named["patient_reference"] = spelling.patient_reference
        named["plan_id"] = None if filters.plan_id is None else spelling.plan_id
    conditions = [getattr(SessionRow, name) == value for name, value in named.items() if value is not None]
    conditions += containing(filters.search, SessionRow.patient_reference, SessionRow.plan_id, SessionRow.fraction_id)
    conditions += [] if filters.since is None else [SessionRow.created_at >= filters.since]
    conditions += [] if filters.until is None else [SessionRow.created_at < filters.until]
    return newest_first(db, SessionRow, cursor, limit, conditions)


def signers(db: Session, session_ids: Sequence[str]) -> dict[str, list[str]]:
    """Return who has signed the report of each of these sessions."""
    wanted = (AuditRow.session_id.in_(session_ids), AuditRow.action == SIGNATURE, AuditRow.outcome == "done")
    found: dict[str, list[str]] = {}
    for row in db.scalars(select(AuditRow).where(*wanted).order_by(AuditRow.sequence)):
        names = found.setdefault(str(row.session_id), [])
        # A note was such a row too, once.
        if row.actor not in names and json.loads(row.detail).get("is_signed", True):
            names.append(row.actor)
    return found


def calibration_page(
    db: Session, cursor: str | None, limit: int, camera: str | None = None
) -> tuple[Sequence[CalibrationRow], str | None]:
    """Return a page of calibrations, newest first, and the next cursor; raise BoundError for an invalid cursor."""
    conditions = [] if camera is None else [CalibrationRow.camera == camera]
    return newest_first(db, CalibrationRow, cursor, limit, conditions)


def model_page(db: Session, session_id: str, cursor: str | None, limit: int) -> tuple[Sequence[ModelRow], str | None]:
    """Return a page of a session's models, newest first, and the next cursor."""
    query = select(ModelRow).where(ModelRow.session_id == session_id).order_by(ModelRow.number.desc())
    if cursor is not None:
        query = query.where(ModelRow.number < _number(cursor))
    return _cut(db, query, limit, lambda row: str(row.number))


def audit_page(
    db: Session, cursor: str | None, limit: int, session_id: str | None, filters: AuditFilter = ALL_ROWS
) -> tuple[Sequence[AuditRow], str | None]:
    """Return a page of audit rows, newest first, and the next cursor."""
    named = {name: getattr(filters, name) for name in ("action", "actor", "outcome")}
    conditions = [getattr(AuditRow, name) == value for name, value in named.items() if value is not None]
    conditions += [] if filters.since is None else [AuditRow.at >= utc_text(filters.since)]
    conditions += [] if filters.until is None else [AuditRow.at < utc_text(filters.until)]
    query = select(AuditRow).where(*conditions).order_by(AuditRow.sequence.desc())
    if session_id is not None:
        query = query.where(AuditRow.session_id == session_id)
    if cursor is not None:
        query = query.where(AuditRow.sequence < _number(cursor))
    return _cut(db, query, limit, lambda row: str(row.sequence))


def transition_page(
    db: Session, session_id: str, cursor: str | None, limit: int, filters: TransitionFilter = ALL_TRANSITIONS
) -> tuple[Sequence[AuditRow], str | None]:
    """Return a page of a session's gate transitions, oldest first, and the next cursor."""
    query = select(AuditRow).where(AuditRow.session_id == session_id, AuditRow.action == TRANSITION)
    named = {name: getattr(filters, name) for name in ("to_state", "reason")}
    query = query.where(*(TRANSITION_DETAIL[name].as_string() == value for name, value in named.items() if value))
    query = query.order_by(AuditRow.sequence)
    if cursor is not None:
        query = query.where(AuditRow.sequence > _number(cursor))
    return _cut(db, query, limit, lambda row: str(row.sequence))


def transition_count(db: Session, session_id: str) -> int:
    """Count a session's gate transitions."""
    query = select(func.count()).select_from(AuditRow)
    return db.scalar(query.where(AuditRow.session_id == session_id, AuditRow.action == TRANSITION)) or 0


def hold_counts(db: Session, session_id: str) -> Counter[str]:
    """Count by reason how often a session's gate began to hold, or to hold for another reason."""
    query = select(AuditRow.detail).where(AuditRow.session_id == session_id, AuditRow.action == TRANSITION)
    changes = (json.loads(detail) for detail in db.scalars(query))
    return Counter(str(change["reason"]) for change in changes if change.get("to_state") in HELD)


def continuation_of(db: Session, session_id: str) -> str | None:
    """Return the started session that continues this one; None if there is none."""
    continued = (SessionRow.continues == session_id, SessionRow.started_at.is_not(None))
    return db.scalar(select(SessionRow.id).where(*continued).limit(1))


def newest_done(db: Session, session_id: str | None, actions: Sequence[str]) -> AuditRow | None:
    """Return the newest row of these actions, of a session or of the service, that were done; None without one."""
    query = select(AuditRow).where(
        AuditRow.session_id == session_id, AuditRow.action.in_(actions), AuditRow.outcome == "done"
    )
    return db.scalar(query.order_by(AuditRow.sequence.desc()).limit(1))


def newest_first(
    db: Session,
    kind: type[DatedT],
    cursor: str | None,
    limit: int,
    filters: Sequence[ColumnElement[bool]] = (),
) -> tuple[Sequence[DatedT], str | None]:
    """List rows that have a creation time, newest first; only rows that meet all conditions."""
    query = select(kind).where(*filters).order_by(kind.created_at.desc(), kind.id.desc())
    if cursor is not None:
        created_at, _, row_id = cursor.partition("_")
        if not (row_id.isascii() and row_id.isalnum()):
            raise _cursor_error(cursor)
        query = query.where(tuple_(kind.created_at, kind.id) < tuple_(_moment(created_at), literal(row_id)))
    return _cut(db, query, limit, lambda row: f"{utc_text(row.created_at)}_{row.id}")


def _cut(
    db: Session, query: Select[RowT], limit: int, cursor_of: Callable[[RowT], str]
) -> tuple[Sequence[RowT], str | None]:
    """Read one row more than the limit, to know whether another page follows."""
    rows = db.scalars(query.limit(limit + 1)).all()
    return rows[:limit], cursor_of(rows[limit - 1]) if len(rows) > limit else None


def _number(cursor: str) -> int:
    if not cursor.isascii() or not cursor.isdigit() or len(cursor) > 18:
        raise _cursor_error(cursor)
    return int(cursor)


def _moment(text: str) -> ColumnElement[datetime]:
    try:
        moment = datetime.fromisoformat(text)
        if moment.tzinfo is None:
            raise _cursor_error(text)
        return literal(moment.astimezone(UTC), UtcTime)
    except (ValueError, OverflowError) as error:  # a zone may lead out of the calendar
        raise _cursor_error(text) from error


def _cursor_error(cursor: str) -> BoundError:
    bound = "a next_cursor of this list"
    return BoundError(f"cursor must be {bound}", field="cursor", value=cursor, bound=bound)


class RetriedWriter:
    """Remembers the last audit row of a failed attempt; the next attempt checks whether that row was committed.

    The write lock guarantees that the outcome of the former transaction is visible. Every write must end with its own
    audit row.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._tried: tuple[object, Seal] | None = None

    def write(self, subject: object, write: Callable[[Session], None]) -> None:
        """Run ``write`` and commit; a retry with the same ``subject`` object does not repeat a committed write."""
        with self._database.write() as db:
            if not self._is_done(db, subject):
                write(db)
                sequence, seal = db.execute(_NEWEST).one()
                self._tried = (subject, (sequence, seal))
        self._tried = None

    def _is_done(self, db: Session, subject: object) -> bool:
        if self._tried is None or self._tried[0] is not subject:
            return False
        sequence, seal = self._tried[1]
        return db.scalar(select(AuditRow.hash).where(AuditRow.sequence == sequence)) == seal
