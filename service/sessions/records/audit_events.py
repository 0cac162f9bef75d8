"""Audit events of a session: gate transitions, training, models and its end."""

import uuid
from collections.abc import Mapping
from datetime import UTC, datetime

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from engine.control import GateTransition
from engine.core.learning_status import LearningEvent, LearningEventKind
from engine.core.motion_model import MotionModel
from engine.motion import header_text
from service.core.schemas import sessions
from service.storage import audit
from service.storage.audit import SYSTEM, Event
from service.storage.database import queries
from service.storage.database.tables import ModelRow, SessionRow


def transition_event(session_id: str, transition: GateTransition) -> Event:
    """Return the audit event of a gate transition."""
    return Event(
        actor=transition.operator or SYSTEM,
        action=queries.TRANSITION,
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
            "armed_by": transition.armed_by,
        },
    )


def notice_event(session_id: str, notice: LearningEvent) -> Event:
    """Return the audit event of a training event."""
    is_refusal = notice.kind is LearningEventKind.REFUSED
    return Event(
        actor=SYSTEM,
        action=f"model.{notice.kind.value}",
        outcome="refused" if is_refusal else "done",
        session_id=session_id,
        detail={**notice.figures, "detail": notice.detail, "timestamp_us": notice.timestamp_us},
    )


def closing_event(row: SessionRow, figures: sessions.Summary, samples: Mapping[str, object], *, actor: str) -> Event:
    """Return the audit event of a session's end, with its figures and the hashes of its samples."""
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
    """Record that a model is in use, and the model itself if it is new; return its id."""
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
