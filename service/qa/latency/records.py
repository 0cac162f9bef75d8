"""The stored latencies of cameras: runs of QA of the kind ``latency``.

Only finished runs that measured a number count; simulated runs never do. An attempt that gave none, as one whose light
was out of view, says nothing of the camera.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import cast

from sqlalchemy import select
from sqlalchemy.orm import Session

from engine.qa.results import QaKind
from service.qa.latency.schemas import CameraMode
from service.qa.schemas import Verdict
from service.storage.database.tables import QaOutcomeRow, QaResultRow, QaRunRow

MEDIAN, P95, WORST, UNCERTAINTY = (f"camera_latency{end}_ms" for end in ("", "_p95", "_worst", "_uncertainty"))


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredLatency:
    """A measured latency [ms] of a camera in one mode."""

    run_id: str
    at: datetime
    operator: str
    camera: CameraMode
    median_ms: float
    p95_ms: float
    worst_ms: float
    uncertainty_ms: float
    verdict: Verdict

    @property
    def counted_ms(self) -> float:
        """What the gate counts for the camera, at least: median and uncertainty, rounded up to a tenth [ms]."""
        return math.ceil(10.0 * (self.median_ms + self.uncertainty_ms) - 1e-6) / 10.0


def newest_latencies(db: Session) -> list[MeasuredLatency]:
    """Return the newest latency of each camera and mode, newest first."""
    query = (
        select(QaRunRow, QaOutcomeRow)
        .join(QaOutcomeRow, QaOutcomeRow.run_id == QaRunRow.id)
        .join(QaResultRow, QaResultRow.run_id == QaRunRow.id)
        .where(
            QaRunRow.kind == QaKind.LATENCY.value,
            QaRunRow.is_simulated.is_(False),
            QaOutcomeRow.status == "finished",
            QaResultRow.code == MEDIAN,
            QaResultRow.value.is_not(None),
        )
        .order_by(QaRunRow.created_at.desc(), QaRunRow.id.desc())
    )
    found: dict[str, MeasuredLatency] = {}
    for run, outcome in db.execute(query).all():
        measured = _measured(db, run, outcome)
        found.setdefault(measured.camera.model_dump_json(), measured)
    return list(found.values())


def largest_counted_ms(measured: Sequence[MeasuredLatency], serial: str) -> float:
    """Return the largest latency [ms] of the camera with this serial number, 0 without one.

    Every mode counts, because the mode is not known before the camera is opened; every camera does where the
    calibration has no serial number.
    """
    return max((one.counted_ms for one in measured if not serial or one.camera.serial == serial), default=0.0)


def _measured(db: Session, run: QaRunRow, outcome: QaOutcomeRow) -> MeasuredLatency:
    request = json.loads(run.request)
    rows = db.scalars(select(QaResultRow).where(QaResultRow.run_id == run.id)).all()
    values = {row.code: math.inf if row.value is None else row.value for row in rows}
    return MeasuredLatency(
        run_id=run.id,
        at=run.created_at,
        operator=run.operator,
        camera=CameraMode.model_validate_json(json.dumps(request["camera"])),
        median_ms=values[MEDIAN],
        p95_ms=values.get(P95, math.inf),
        worst_ms=values.get(WORST, math.inf),
        uncertainty_ms=values.get(UNCERTAINTY, math.inf),
        verdict=cast("Verdict", outcome.verdict or "fail"),
    )
