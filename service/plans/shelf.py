"""The plans of the site: read, written down once, never changed; the file itself is not kept.

What is kept is what `service.plans.reading` returns, under the name that the site has for the patient. No part of a
file becomes a path, and nothing is written before all of it is read.
"""

import hashlib
import hmac
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from service import audit
from service.audit import Event
from service.audit_log import AuditLog
from service.db.engine import Database
from service.db.models import PlanContradictionRow, PlanRow
from service.idempotency import CallersKey, InProgress, earlier_answer, keep_answer
from service.plan_schemas import Plan, PlanPage, RtPlan
from service.plans import records
from service.plans.errors import PlanBusyError, PlanConflictError
from service.plans.reading import read_plan
from service.plans.tags import Tag, named
from service.ports import Kept
from service.settings import Settings

ACTION, CONTRADICTED = "plan.import", "plan.contradicted"
REJECTED = "REJECTED"
AT_ONCE = 2
"""Files that are in memory at a time: each may be as large as the site lets it, and is read beside the gate."""


class PlanShelf:
    """Stored plans."""

    def __init__(self, database: Database, log: AuditLog, settings: Settings) -> None:
        self._database = database
        self._log = log
        self._secret = settings.plan_patient_secret
        self._places = threading.BoundedSemaphore(AT_ONCE)
        self._in_progress = InProgress()

    @contextmanager
    def taking_one(self) -> Iterator[None]:
        """Take a place for a file; raise PlanBusyError at once where there is none."""
        if not self._places.acquire(blocking=False):
            bound = f"one of {AT_ONCE} at a time"
            msg = f"{AT_ONCE} plans are being read: try again in a second"
            raise PlanBusyError(msg, field="body", value="one more", bound=bound)
        try:
            yield
        finally:
            self._places.release()

    def keep(self, body: bytes, operator: str, key: CallersKey | None) -> Kept[Plan]:
        """Read a file and keep what it says; the same plan again is the plan that is there."""
        refusals = self._log.refusals(actor=operator, action=ACTION, detail={"bytes": len(body)})
        with refusals, self._in_progress.only(key):
            plan = self._renamed(read_plan(body))
            sha256 = hashlib.sha256(body).hexdigest()
            with self._database.write() as db:
                earlier = earlier_answer(db, ACTION, key, body, Plan)
                if earlier is not None:
                    return Kept(answer=earlier, is_replay=True)
                row, is_known = _kept_row(db, plan, sha256, operator)
                differing = _differing(records.content(row), plan)
                if not differing:
                    detail = _detail(row, sha256, is_known=is_known)
                    audit.append(db, Event(actor=operator, action=ACTION, detail=detail))
                    answer = records.told(db, row)
                    keep_answer(db, ACTION, key, body, answer)
                elif not _is_only_approved(records.content(row), plan, differing):
                    _contradict(db, row, plan, sha256, operator, differing)
            if differing:  # behind the transaction: what was said is kept
                raise _conflict(plan, differing)
            return Kept(answer=answer, is_replay=is_known)

    def page(self, cursor: str | None, limit: int, *, patient_reference: str | None, label: str | None) -> PlanPage:
        """List them, newest first."""
        with self._database.read() as db:
            return records.page(db, cursor, limit, patient_reference=patient_reference, label=label)

    def detail(self, plan_id: str) -> Plan:
        """Read one."""
        with self._database.read() as db:
            return records.told(db, records.plan_row(db, plan_id))

    def _renamed(self, plan: RtPlan) -> RtPlan:
        """Call the patient as the site does."""
        if self._secret is None:
            return plan
        hashed = hmac.new(self._secret, plan.patient_reference.encode(), hashlib.sha256).hexdigest()
        return plan.model_copy(update={"patient_reference": f"h-{hashed[:32]}"})


def _kept_row(db: Session, plan: RtPlan, sha256: str, operator: str) -> tuple[PlanRow, bool]:
    """Find or make the row of a plan; the one that is there may say something else."""
    row = records.row_of_uid(db, plan.sop_instance_uid)
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


def _differing(there: RtPlan, plan: RtPlan) -> list[str]:
    """Say in what they differ; an archive may write a file anew, and what it says must be the same."""
    return [name for name in RtPlan.model_fields if getattr(there, name) != getattr(plan, name)]


def _is_only_approved(there: RtPlan, plan: RtPlan, differing: list[str]) -> bool:
    """Whether a plan was approved meanwhile, and nothing else: no reason to keep it from being treated."""
    return set(differing) <= {"approval", "notes"} and there.approval != REJECTED and plan.approval == "APPROVED"


def _contradict(db: Session, row: PlanRow, plan: RtPlan, sha256: str, operator: str, differing: list[str]) -> None:
    """Remember a file that says something else of a plan; each file once."""
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
    msg = f"another plan has this SOP Instance UID: they differ in {', '.join(differing)}"
    bound = "of one content: a changed plan needs a UID of its own"
    return PlanConflictError(msg, field=named(Tag.SOP_INSTANCE), value=plan.sop_instance_uid, bound=bound)


def _detail(row: PlanRow, sha256: str, *, is_known: bool) -> dict[str, object]:
    told = {name: getattr(row, name) for name in ("kind", "sop_instance_uid", "label", "patient_reference", "gating")}
    return {"rt_plan_id": row.id, "sha256": sha256, "is_new": not is_known, **told}
