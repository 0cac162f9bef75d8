"""A session's own events in the audit's words: what the gate did, what was learned, how it ended."""

import uuid
from collections.abc import Mapping
from datetime import UTC, datetime

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from engine.live import GateTransition
from engine.model import MotionModel
from engine.model_file import header_text
from engine.notices import LearningNotice, NoticeKind
from service import audit, schemas
from service.audit import SYSTEM, Event
from service.db import repository
from service.db.models import ModelRow, SessionRow


def transition_event(session_id: str, transition: GateTransition) -> Event:
    """Put a gate transition into the audit's words."""
    return Event(
        actor=transition.operator or SYSTEM,
        action=repository.TRANSITION,
        session_id=session_id,
        detail={
            "from_state": transition.from_state.value,
            "to_state": transition.to_state.value,
            "reason": None if transition.reason is None else transition.reason.value,
            "operator": transition.operator,
            "detail": transition.detail,
            "frame_index": transition.frame_index,
            "captured_us": transition.captured_us,
            "received_ns": transition.received_ns,
            "decided_ns": transition.decided_ns,
            "asserted_ns": transition.asserted_ns,
            "captured_ns": transition.captured_ns,
            "latency_ms": transition.latency_ms,
            "number": transition.number,
        },
    )


def notice_event(session_id: str, notice: LearningNotice) -> Event:
    """Put what the learning has to tell into the audit's words."""
    is_refusal = notice.kind is NoticeKind.REFUSED
    return Event(
        actor=SYSTEM,
        action=f"model.{notice.kind.value}",
        outcome="refused" if is_refusal else "done",
        session_id=session_id,
        detail={**notice.figures, "detail": notice.detail, "timestamp_us": notice.timestamp_us},
    )


def closing_event(row: SessionRow, figures: schemas.Summary, samples: Mapping[str, object], *, actor: str) -> Event:
    """Tell how a session ended, with its figures and what its samples are known by."""
    return Event(
        actor=actor,
        action="session.close",
        outcome="failed" if row.status in {"failed", "interrupted"} else "done",
        session_id=row.id,
        detail={
            "status": row.status,
            "detail": row.status_detail,
            "summary": figures.model_dump(),
            "samples": dict(samples),
        },
    )


def record_model(db: Session, session_id: str, sha256: str, model: MotionModel) -> str:
    """Note that a model is measured with from now on, and keep it if it is a new one; returns its id."""
    mine = ModelRow.session_id == session_id
    row = db.scalar(select(ModelRow).where(mine, ModelRow.sha256 == sha256))
    is_new = row is None
    if row is None:
        row = ModelRow(
            id=uuid.uuid4().hex,
            session_id=session_id,
            number=(db.scalar(select(func.max(ModelRow.number)).where(mine)) or 0) + 1,
            sha256=sha256,
            spectrum=audit.canonical_json([float(share) for share in model.spectrum]),
            components=len(model.components),
            created_at=datetime.now(UTC),
            provenance=header_text(model),
        )
        db.add(row)
    detail = {"model_id": row.id, "number": row.number, "sha256": sha256, "is_new": is_new}
    event = Event(actor=SYSTEM, action="model.in_use", session_id=session_id, detail=detail)
    audit.append(db, event)
    return row.id
