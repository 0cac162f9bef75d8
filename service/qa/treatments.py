"""The holds of the treatments since the last QA run: their time to the accelerator's beam off, as a figure of a run.

The times are the audit's rows `beam.off`, one for each permit of a session that ended with the beam on.
"""

import json

import numpy as np
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from engine.qa.results import QaFigure, QaKind
from service.storage.database import queries
from service.storage.database.tables import AuditRow, QaOutcomeRow, QaRunRow, SessionRow

CODE = "treatment_beam_off_ms"


def treatment_figures(db: Session, *, is_simulated_beam: bool) -> list[QaFigure]:
    """Return the figure of the holds since the newest finished run; none where no beam-off was measured.

    Parameters
    ----------
    is_simulated_beam
        Which sessions count: those of a simulated line, or of a real one.
    """
    since = db.scalar(
        select(func.max(QaRunRow.created_at))
        .join(QaOutcomeRow, QaOutcomeRow.run_id == QaRunRow.id)
        .where(
            QaOutcomeRow.status == "finished",
            QaRunRow.is_simulated.is_(False),
            QaRunRow.kind != QaKind.LATENCY.value,  # which has no figure of the treatments
        )
    )
    query = (
        select(AuditRow.detail, AuditRow.session_id)
        .join(SessionRow, SessionRow.id == AuditRow.session_id)
        .where(AuditRow.action == queries.BEAM_OFF, SessionRow.is_simulated_beam.is_(is_simulated_beam))
    )
    if since is not None:
        query = query.where(SessionRow.started_at > since)
    rows = db.execute(query).all()
    if not rows:
        return []
    offs_ms = [float(json.loads(detail)["off_ms"]) for detail, _ in rows]
    count = f"{len(offs_ms)} holds in {len({session_id for _, session_id in rows})} sessions since the last run"
    detail = f"{count}: median {np.median(offs_ms):.1f} ms, slowest {max(offs_ms):.1f} ms"
    return [QaFigure(code=CODE, value=float(np.percentile(offs_ms, 95.0)), detail=detail)]
