"""Comparison of the patient's body with earlier sessions, whether or not a stored model is used.

The first model that a session learns has the mean surface of the region, and so have those of the patient's earlier
sessions. After a rigid motion the difference of shape shows another body, or markers at other places; shift and tilt
show another position, where the calibration is the same. It is a warning: nothing is held.
"""

import logging
from dataclasses import dataclass

from sqlalchemy import select

from engine.core.errors import TidegateError
from engine.core.frames import FloatArray
from engine.core.motion_model import MotionModel
from engine.core.sentences import listed, say
from engine.motion import PatientMatchLimits, rigid_between
from service.engine_host.protocols import BodyMatch
from service.storage.audit import SYSTEM, Event
from service.storage.database.engine import Database
from service.storage.database.tables import ModelRow, SessionRow
from service.storage.files.motion_models import ModelStore

logger = logging.getLogger(__name__)

ACTION = "session.body"
MOST_TRIED = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EarlierBody:
    """The surface of the patient's newest earlier model, in the depth camera's frame [mm], shape (nodes, 3)."""

    session_id: str
    model_id: str
    surface_mm: FloatArray
    calibration_sha256: str


def earlier_body(
    database: Database, models: ModelStore, *, session_id: str, patient_reference: str
) -> EarlierBody | None:
    """Return the body of the patient's newest earlier session; None if there is no readable model of one."""
    with database.read() as db:
        query = (
            select(ModelRow.session_id, ModelRow.id, ModelRow.sha256)
            .join(SessionRow, SessionRow.id == ModelRow.session_id)
            .where(SessionRow.patient_reference == patient_reference, SessionRow.id != session_id)
            .order_by(ModelRow.created_at.desc(), ModelRow.id)
            .limit(MOST_TRIED)
        )
        rows = [tuple(row) for row in db.execute(query)]
    for earlier_session, model_id, sha256 in rows:
        try:
            model = models.load(sha256)
        except (TidegateError, OSError) as error:
            logger.warning("model %s cannot be read for a comparison: %s", model_id, type(error).__name__)
            continue
        if model.surface_mm is not None:
            return EarlierBody(
                session_id=earlier_session,
                model_id=model_id,
                surface_mm=model.surface_mm,
                calibration_sha256=model.calibration_sha256,
            )
    return None


def compare_bodies(earlier: EarlierBody, today: MotionModel, limits: PatientMatchLimits) -> BodyMatch | None:
    """Compare the surface of a model that was learned today; None if too little of both is known."""
    if today.surface_mm is None or today.surface_mm.shape != earlier.surface_mm.shape:
        return None
    rigid = rigid_between(earlier.surface_mm, today.surface_mm)
    if rigid is None:
        return None
    is_position_compared = earlier.calibration_sha256 == today.calibration_sha256
    warnings = []
    if not rigid.shape_mm <= limits.max_shape_mm:
        warnings.append(
            say(
                "the body differs by {shape_mm:.1f} mm from the patient's earlier session, {max_shape_mm:g} mm "
                "allowed: another patient, or markers at other places",
                shape_mm=rigid.shape_mm,
                max_shape_mm=limits.max_shape_mm,
            )
        )
    if is_position_compared and not rigid.distance_mm <= limits.max_shift_mm:
        warnings.append(
            say(
                "the patient lies {distance_mm:.0f} mm from there, {max_shift_mm:g} mm allowed",
                distance_mm=rigid.distance_mm,
                max_shift_mm=limits.max_shift_mm,
            )
        )
    if is_position_compared and not rigid.tilt_deg <= limits.max_tilt_deg:
        warnings.append(
            say(
                "the body is turned by {tilt_deg:.0f} deg, {max_tilt_deg:g} deg allowed",
                tilt_deg=rigid.tilt_deg,
                max_tilt_deg=limits.max_tilt_deg,
            )
        )
    return BodyMatch(
        session_id=earlier.session_id,
        model_id=earlier.model_id,
        shift_mm=rigid.shift_mm,
        tilt_deg=rigid.tilt_deg,
        shape_mm=rigid.shape_mm,
        is_position_compared=is_position_compared,
        warning=listed("; ", warnings) or None,
    )


def body_event(session_id: str, match: BodyMatch) -> Event:
    """Return the audit event of a comparison."""
    detail = {
        "earlier_session_id": match.session_id,
        "model_id": match.model_id,
        **{f"shift_{axis}_mm": round(value, 2) for axis, value in zip("xyz", match.shift_mm, strict=True)},
        "tilt_deg": round(match.tilt_deg, 2),
        "shape_mm": round(match.shape_mm, 2),
        "is_position_compared": match.is_position_compared,
        "warning": match.warning,
    }
    return Event(actor=SYSTEM, action=ACTION, session_id=session_id, detail=detail)
