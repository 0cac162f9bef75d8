"""Repository of imported plans: stored once, never changed.

It stores the result of `service.planning.rt_plan.reading` with the site's reference for the patient, not the file. No
part of a file becomes a path, and nothing is written before the file is read completely.

Database queries on stored plans, and their conversion to answers.
"""

import hashlib
import hmac
import json
import threading
import uuid
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime

from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session

from service.core.errors import NotFoundError
from service.core.list_filters import ALL_PLANS, PlanFilter
from service.core.schemas.plans import Plan, PlanContradiction, PlanLastSession, PlanPage, PlanSummary, RtPlan
from service.core.settings.settings import Settings
from service.planning.rt_plan.errors import PlanBusyError, PlanConflictError
from service.planning.rt_plan.reading import read_plan
from service.planning.rt_plan.tags import Tag, named
from service.storage import audit
from service.storage.audit import Event
from service.storage.audit.log import AuditLog
from service.storage.database import identities, queries
from service.storage.database.engine import Database
from service.storage.database.idempotency import CallersKey, IdempotentAnswer, InProgress, earlier_answer, keep_answer
from service.storage.database.tables import PlanContradictionRow, PlanRow, SessionRow

ACTION, CONTRADICTED = "plan.import", "plan.contradicted"
REJECTED = "REJECTED"
MAX_CONCURRENT = 2
"""Files in memory at a time: each may have the site's maximum size and is read while the gate runs."""
COLUMNS = ("id", "kind", "sop_instance_uid", "patient_reference", "label", "gating", "imported_by", "created_at")


class PlanRepository:
    """Imports plans and reads stored ones."""

    def __init__(self, database: Database, log: AuditLog, settings: Settings) -> None:
        self._database = database
        self._log = log
        self._secret = settings.plan_patient_secret
        self._slots = threading.BoundedSemaphore(MAX_CONCURRENT)
        self._in_progress = InProgress()

    @contextmanager
    def upload_slot(self) -> Iterator[None]:
        """Reserve one of the upload slots for the block; raise PlanBusyError if all are in use."""
        if not self._slots.acquire(blocking=False):
            bound = f"one of {MAX_CONCURRENT} at a time"
            msg = f"{MAX_CONCURRENT} plans are being read: try again in a second"
            raise PlanBusyError(msg, field="body", value="one more", bound=bound)
        try:
            yield
        finally:
            self._slots.release()

    def add(self, body: bytes, operator: str, key: CallersKey | None) -> IdempotentAnswer[Plan]:
        """Read and store a plan; the same content again returns the stored plan.

        Raises
        ------
        PlanError
            The file is refused, or its UID belongs to a stored plan with other content (PlanConflictError).
        """
        refusals = self._log.refusals(actor=operator, action=ACTION, detail={"bytes": len(body)})
        with refusals, self._in_progress.only(key):
            plan = self._pseudonymised(read_plan(body))
            sha256 = hashlib.sha256(body).hexdigest()
            with self._database.write() as db:
                earlier = earlier_answer(db, ACTION, key, body, Plan)
                if earlier is not None:
                    return IdempotentAnswer(answer=earlier, is_replay=True)
                row, is_known = _stored_row(db, plan, sha256, operator)
                differing = _differing(row, plan)
                if not differing:
                    detail = _detail(row, sha256, is_known=is_known)
                    audit.append(db, Event(actor=operator, action=ACTION, detail=detail))
                    answer = plan_answer(db, row)
                    keep_answer(db, ACTION, key, body, answer)
                elif not _is_only_approved(content(row), plan, differing):
                    _contradict(db, row, plan, sha256, operator, differing)
            if differing:  # after the transaction, so that the contradiction is stored
                raise _conflict(plan, differing)
            return IdempotentAnswer(answer=answer, is_replay=is_known)

    def page(self, cursor: str | None, limit: int, wanted: PlanFilter = ALL_PLANS) -> PlanPage:
        """List plans, newest first."""
        with self._database.read() as db:
            return page(db, cursor, limit, wanted)

    def detail(self, plan_id: str) -> Plan:
        """Return one plan; raise NotFoundError if there is none."""
        with self._database.read() as db:
            return plan_answer(db, plan_row(db, plan_id))

    def _pseudonymised(self, plan: RtPlan) -> RtPlan:
        """Replace the patient ID by its keyed hash if the site sets a secret."""
        if self._secret is None:
            return plan
        hashed = hmac.new(self._secret, plan.patient_reference.encode(), hashlib.sha256).hexdigest()
        return plan.model_copy(update={"patient_reference": f"h-{hashed[:32]}"})


def _stored_row(db: Session, plan: RtPlan, sha256: str, operator: str) -> tuple[PlanRow, bool]:
    """Return the row of the plan's UID and whether it existed; an existing row may have other content."""
    row = row_of_uid(db, plan.sop_instance_uid)
    if row is not None:
        return row, True
    row = PlanRow(
        id=uuid.uuid4().hex,
        sha256=sha256,
        document=plan.model_dump_json(),
        imported_by=operator,
        created_at=datetime.now(UTC),
        **plan.model_dump(include={"sop_instance_uid", "kind", "label", "patient_reference", "gating"}),
    )
    db.add(row)
    db.flush()
    return row, False


def _differing(row: PlanRow, plan: RtPlan) -> list[str]:
    """Return the names of differing fields; the bytes may differ, because archives rewrite files.

    Positions are not compared with a plan that was stored before they were read; how its text was coded never is.
    """
    stored = content(row)
    if not has_positions(row):
        plan = plan.model_copy(update={"setups": [one.model_copy(update={"position": None}) for one in plan.setups]})
    compared = RtPlan.model_fields.keys() - {"character_set"}
    return [name for name in RtPlan.model_fields if name in compared and getattr(stored, name) != getattr(plan, name)]


def _is_only_approved(stored: RtPlan, plan: RtPlan, differing: list[str]) -> bool:
    """Whether the only change is a later approval, which is no contradiction."""
    return set(differing) <= {"approval", "notes"} and stored.approval != REJECTED and plan.approval == "APPROVED"


def _contradict(db: Session, row: PlanRow, plan: RtPlan, sha256: str, operator: str, differing: list[str]) -> None:
    """Store a contradicting file of a plan, each file once, with an audit entry."""
    known = select(PlanContradictionRow.id).where(
        PlanContradictionRow.plan_id == row.id, PlanContradictionRow.sha256 == sha256
    )
    if db.scalar(known) is not None:
        return
    db.add(
        PlanContradictionRow(
            id=uuid.uuid4().hex,
            plan_id=row.id,
            sha256=sha256,
            approval=plan.approval,
            differing=" ".join(differing),
            imported_by=operator,
            created_at=datetime.now(UTC),
        )
    )
    detail = {"rt_plan_id": row.id, "sha256": sha256, "approval": plan.approval, "differing": differing}
    audit.append(db, Event(actor=operator, action=CONTRADICTED, detail=detail))


def _conflict(plan: RtPlan, differing: list[str]) -> PlanConflictError:
    msg = f"another plan has this SOP Instance UID; they differ in {', '.join(differing)}"
    bound = "the UID of one content: a changed plan needs a new UID"
    return PlanConflictError(msg, field=named(Tag.SOP_INSTANCE), value=plan.sop_instance_uid, bound=bound)


def _detail(row: PlanRow, sha256: str, *, is_known: bool) -> dict[str, object]:
    fields = {name: getattr(row, name) for name in ("kind", "sop_instance_uid", "label", "patient_reference", "gating")}
    return {"rt_plan_id": row.id, "sha256": sha256, "is_new": not is_known, **fields}


def plan_row(db: Session, plan_id: str) -> PlanRow:
    """Return the row of a plan; raise NotFoundError if there is none."""
    row = db.get(PlanRow, plan_id)
    if row is None:
        msg = "there is no such plan"
        raise NotFoundError(msg, field="plan_id", value=plan_id)
    return row


def row_of_uid(db: Session, uid: str) -> PlanRow | None:
    """Return the row of the plan with a SOP Instance UID, or None."""
    return db.scalar(select(PlanRow).where(PlanRow.sop_instance_uid == uid))


def contradictions(db: Session, plan_id: str) -> list[PlanContradiction]:
    """Return the later files with other content under the plan's UID, newest first."""
    of_plan = select(PlanContradictionRow).where(PlanContradictionRow.plan_id == plan_id)
    rows = db.scalars(of_plan.order_by(PlanContradictionRow.created_at.desc(), PlanContradictionRow.id.desc()))
    return [
        PlanContradiction(
            approval=row.approval,
            differing=row.differing.split(),
            imported_by=row.imported_by,
            created_at=row.created_at,
        )
        for row in rows
    ]


def plan_answer(db: Session, row: PlanRow) -> Plan:
    """Return the stored plan with its newest contradiction."""
    return Plan(
        **dict(content(row)),
        id=row.id,
        sha256=row.sha256,
        imported_by=row.imported_by,
        created_at=row.created_at,
        contradicted=next(iter(contradictions(db, row.id)), None),
    )


def content(row: PlanRow) -> RtPlan:
    """Return the content that was read from the file."""
    return RtPlan.model_validate_json(row.document)


def has_positions(row: PlanRow) -> bool:
    """Whether the setups were stored with their positions: earlier versions did not read them."""
    return all("position" in setup for setup in json.loads(row.document)["setups"])


def page(db: Session, cursor: str | None, limit: int, wanted: PlanFilter = ALL_PLANS) -> PlanPage:
    """List plans, newest first, with what was done of each."""
    named_by = ((PlanRow.patient_reference, wanted.patient_reference), (PlanRow.label, wanted.label))
    filters: list[ColumnElement[bool]] = [column == value for column, value in named_by if value is not None]
    filters += queries.containing(wanted.search, PlanRow.patient_reference, PlanRow.label)
    rows, next_cursor = queries.newest_first(db, PlanRow, cursor, limit, filters)
    named = [identities.stored(db, row.patient_reference, row.label) for row in rows]
    done = _done(db, {one.patient_reference for one in named})
    items = [
        _summary(row, done.get((one.patient_reference, one.plan_id), [])) for row, one in zip(rows, named, strict=True)
    ]
    return PlanPage(items=items, next_cursor=next_cursor)


def _done(db: Session, patients: set[str]) -> dict[tuple[str, str], list[SessionRow]]:
    """Return the sessions of these patients that were started, by patient and plan, the newest first."""
    query = select(SessionRow).where(SessionRow.patient_reference.in_(patients), SessionRow.started_at.is_not(None))
    found: dict[tuple[str, str], list[SessionRow]] = defaultdict(list)
    for row in db.scalars(query.order_by(SessionRow.started_at.desc(), SessionRow.id)):
        found[row.patient_reference, row.plan_id].append(row)
    return found


def _summary(row: PlanRow, done: Sequence[SessionRow]) -> PlanSummary:
    planned = [one.fractions_planned for one in content(row).fraction_groups if one.fractions_planned is not None]
    return PlanSummary.model_validate(
        {name: getattr(row, name) for name in COLUMNS}
        | {
            "fractions_planned": max(planned, default=None),
            "next_fraction": 1 + max((one.fraction_number or 0 for one in done), default=0),
            "last_session": {name: getattr(done[0], name) for name in PlanLastSession.model_fields} if done else None,
        }
    )
