"""What clinical mode requires of the camera's latency before arming, and what the gate counts for it.

The gate counts the larger of the site's `TIDEGATE_CAMERA_LATENCY_MS` and what was measured of the session's camera, in
every mode. Clinical mode refuses to arm where the measurement is missing for this camera and mode, too old, failed, or
larger than the site's value. This runs at start and at arming, not per frame.

The stored latencies of cameras: runs of QA of the kind ``latency``.

Only finished runs that measured a number count; simulated runs never do. An attempt that gave none, as one whose light
was out of view, says nothing of the camera.

The cameras' latencies as the API and the command line list them.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime, timedelta
from typing import cast

from sqlalchemy import select
from sqlalchemy.orm import Session

from engine.capture import SourceDescription
from engine.gating import LIMIT_BOUNDS
from engine.qa import QaKind
from service.core.errors import BoundError, CameraLatencyError
from service.core.settings.names import setting_name
from service.core.settings.settings import Settings
from service.qa.latency import schemas
from service.qa.latency.schemas import CameraMode
from service.qa.schemas import Verdict
from service.storage.database.engine import Database
from service.storage.database.tables import QaOutcomeRow, QaResultRow, QaRunRow

MEDIAN, P95, WORST, UNCERTAINTY = (f"camera_latency{end}_ms" for end in ("", "_p95", "_worst", "_uncertainty"))
COMMAND = "tidegate qa latency"
ADVICE = f"measure it ({COMMAND}; docs/2-clinical/latency.md)"
SETTING = setting_name("camera_latency_ms")


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


def counted_latency_ms(db: Session, settings: Settings, serial: str) -> float:
    """Return what the gate counts for the camera [ms]: the larger of the site's value and the measured one.

    Raises
    ------
    BoundError
        The measured one is beyond what the gate accepts.
    """
    measured_ms = largest_counted_ms(newest_latencies(db), serial)
    _, most = LIMIT_BOUNDS["camera_latency_ms"]
    most = min(most, settings.max_latency_ms)
    if measured_ms >= most:
        bound = f"below {most:g}, what this site allows from light to beam line"
        msg = f"the camera's measured latency is {measured_ms:g} ms: must be {bound}; shorten it, then {ADVICE}"
        raise BoundError(msg, field="camera_latency_ms", value=measured_ms, bound=bound)
    return max(settings.camera_latency_ms, measured_ms)


def refuse_unmeasured(database: Database, settings: Settings, camera: SourceDescription | None) -> None:
    """Raise CameraLatencyError in clinical mode if this session's camera may not gate a beam."""
    if settings.mode != "clinical":
        return
    with database.read() as db:
        reason = refusal(newest_latencies(db), settings, camera, datetime.now(UTC))
    if reason is not None:
        bound = (
            f"measured of this camera and mode within {settings.qa_latency_max_age_days:g} days, and at most "
            f"{SETTING} ({settings.camera_latency_ms:g})"
        )
        raise CameraLatencyError(reason, field="camera_latency_ms", bound=bound)


def refuse_unmeasured_site(database: Database, settings: Settings) -> None:
    """Raise CameraLatencyError in clinical mode if no camera at all has a latency with which it may gate a beam."""
    if settings.mode != "clinical":
        return
    with database.read() as db:
        measured = newest_latencies(db)
    now = datetime.now(UTC)
    reasons = [unfit(one, settings, now) for one in measured] or [f"no camera's latency was ever measured: {ADVICE}"]
    if None not in reasons:
        raise CameraLatencyError(str(reasons[0]), field="camera_latency_ms", bound="measured of one camera at least")


def refusal(
    measured: Sequence[MeasuredLatency], settings: Settings, camera: SourceDescription | None, now: datetime
) -> str | None:
    """Return why clinical mode refuses to arm with a camera, and what to do; None if it does not."""
    if camera is None:
        return "the session's camera is not known yet: arm again when it is open"
    if not camera.is_live:
        return None  # a recording permits no real beam in clinical mode
    wanted = schemas.CameraMode.of(camera)
    same = [one for one in measured if one.camera.identity == wanted.identity]
    if not same:
        return f"the latency of this camera ({wanted.identity}) was never measured: {ADVICE}"
    found = next((one for one in same if one.camera == wanted), None)
    if found is None:
        modes = "; ".join(one.camera.mode_text for one in same)
        return (
            f"the latency of this camera ({wanted.identity}) was measured in another mode ({modes}) than this "
            f"session's ({wanted.mode_text}): {ADVICE}"
        )
    return unfit(found, settings, now)


def unfit(found: MeasuredLatency, settings: Settings, now: datetime) -> str | None:
    """Return why clinical mode refuses to arm with a measured latency, and what to do; None if it does not."""
    run_text = f"the latency of camera {found.camera.identity}, measured on {found.at.astimezone(UTC):%Y-%m-%d},"
    age = now - found.at
    if age < timedelta(0):
        return f"{run_text} is of the future: check this machine's clock"
    if age > timedelta(days=settings.qa_latency_max_age_days):
        return f"{run_text} is older than {settings.qa_latency_max_age_days:g} days: {ADVICE}"
    if found.verdict == "fail":
        return f"{run_text} failed its bounds (run {found.run_id[:8]}): find the cause, then {ADVICE}"
    if found.counted_ms > settings.camera_latency_ms:
        return (
            f"{run_text} is {found.median_ms:.1f} ms and uncertain by {found.uncertainty_ms:.1f} ms, more than the "
            f"{settings.camera_latency_ms:g} ms that the site counts: set {SETTING} to {found.counted_ms:g} or more "
            "and restart"
        )
    return None


def latency_list(db: Session, settings: Settings) -> schemas.CameraLatencyList:
    """Return the newest latency of each camera and mode, each with why clinical mode would refuse it."""
    now = datetime.now(UTC)
    return schemas.CameraLatencyList(
        configured_ms=settings.camera_latency_ms,
        max_age_days=settings.qa_latency_max_age_days,
        items=[
            schemas.CameraLatency(
                **{field.name: getattr(one, field.name) for field in fields(one)},
                counted_ms=one.counted_ms,
                refusal=unfit(one, settings, now),
            )
            for one in newest_latencies(db)
        ],
    )
