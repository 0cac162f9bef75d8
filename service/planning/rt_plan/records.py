"""Database queries on stored plans, and their conversion to answers."""

import json
from collections.abc import Sequence

from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session

from service.core.errors import NotFoundError
from service.core.schemas.plans import Plan, PlanContradiction, PlanPage, PlanSummary, RtPlan
from service.storage.database import queries
from service.storage.database.tables import PlanContradictionRow, PlanRow

COLUMNS = ("id", "kind", "sop_instance_uid", "patient_reference", "label", "gating", "imported_by", "created_at")


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


def page(db: Session, cursor: str | None, limit: int, *, patient_reference: str | None, label: str | None) -> PlanPage:
    """List plans, newest first, optionally of one patient or one label."""
    filters: Sequence[ColumnElement[bool]] = [
        column == value
        for column, value in ((PlanRow.patient_reference, patient_reference), (PlanRow.label, label))
        if value is not None
    ]
    rows, next_cursor = queries.newest_first(db, PlanRow, cursor, limit, filters)
    return PlanPage(items=[_summary(row) for row in rows], next_cursor=next_cursor)


def _summary(row: PlanRow) -> PlanSummary:
    return PlanSummary.model_validate({name: getattr(row, name) for name in COLUMNS})
