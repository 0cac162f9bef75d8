"""Plans in the database: found, listed, told."""

from collections.abc import Sequence

from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session

from service.db import repository
from service.db.models import PlanContradictionRow, PlanRow
from service.errors import NotFoundError
from service.plan_schemas import Plan, PlanContradiction, PlanPage, PlanSummary, RtPlan

COLUMNS = ("id", "kind", "sop_instance_uid", "patient_reference", "label", "gating", "imported_by", "created_at")


def plan_row(db: Session, plan_id: str) -> PlanRow:
    """Find a plan, or raise NotFoundError."""
    row = db.get(PlanRow, plan_id)
    if row is None:
        msg = "there is no such plan"
        raise NotFoundError(msg, field="plan_id", value=plan_id)
    return row


def row_of_uid(db: Session, uid: str) -> PlanRow | None:
    """Find the plan with a SOP Instance UID."""
    return db.scalar(select(PlanRow).where(PlanRow.sop_instance_uid == uid))


def contradictions(db: Session, plan_id: str) -> list[PlanContradiction]:
    """Tell which later files contradict a plan, newest first."""
    mine = select(PlanContradictionRow).where(PlanContradictionRow.plan_id == plan_id)
    rows = db.scalars(mine.order_by(PlanContradictionRow.created_at.desc(), PlanContradictionRow.id.desc()))
    return [
        PlanContradiction(
            approval=row.approval,
            differing=row.differing.split(),
            imported_by=row.imported_by,
            created_at=row.created_at,
        )
        for row in rows
    ]


def told(db: Session, row: PlanRow) -> Plan:
    """Tell a plan as it was read, and what contradicts it."""
    return Plan(
        **dict(content(row)),
        id=row.id,
        sha256=row.sha256,
        imported_by=row.imported_by,
        created_at=row.created_at,
        contradicted=next(iter(contradictions(db, row.id)), None),
    )


def content(row: PlanRow) -> RtPlan:
    """Return what was read of the file."""
    return RtPlan.model_validate_json(row.document)


def page(db: Session, cursor: str | None, limit: int, *, patient_reference: str | None, label: str | None) -> PlanPage:
    """List plans, newest first, of one patient or of one label where that is asked for."""
    wanted: Sequence[ColumnElement[bool]] = [
        column == value
        for column, value in ((PlanRow.patient_reference, patient_reference), (PlanRow.label, label))
        if value is not None
    ]
    rows, next_cursor = repository.newest_first(db, PlanRow, cursor, limit, wanted)
    return PlanPage(items=[_summary(row) for row in rows], next_cursor=next_cursor)


def _summary(row: PlanRow) -> PlanSummary:
    return PlanSummary.model_validate({name: getattr(row, name) for name in COLUMNS})
