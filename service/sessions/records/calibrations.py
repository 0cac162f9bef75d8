"""Camera calibrations: checked by the engine's parser, stored under the hash of their content."""

import json
import uuid
from datetime import UTC, datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from engine.calibration.camera_calibration import Calibration
from engine.calibration.formats.convert import read_upload
from service.core.schemas import calibrations as schemas
from service.engine_host.site_rules.uncalibrated import refuse_reserved_name
from service.storage import audit
from service.storage.audit import Event
from service.storage.audit.log import AuditLog
from service.storage.database import queries
from service.storage.database.engine import Database
from service.storage.database.idempotency import CallersKey, IdempotentAnswer, InProgress, earlier_answer, keep_answer
from service.storage.database.tables import CalibrationRow

ACTION = "calibration.upload"


class CalibrationRepository:
    """Stores, lists and reads calibrations."""

    def __init__(self, database: Database, log: AuditLog) -> None:
        self._database = database
        self._log = log
        self._in_progress = InProgress()

    def upload(
        self, body: bytes, operator: str, key: CallersKey | None
    ) -> IdempotentAnswer[schemas.UploadedCalibration]:
        """Check and store one; the same content again returns the stored calibration."""
        refusals = self._log.refusals(actor=operator, action=ACTION, detail={"bytes": len(body)})
        with refusals, self._in_progress.only(key):
            converted = read_upload(body)
            calibration = converted.calibration
            refuse_reserved_name(calibration)
            with self._database.write() as db:
                earlier = earlier_answer(db, ACTION, key, body, schemas.UploadedCalibration)
                if earlier is not None:
                    return IdempotentAnswer(answer=earlier, is_replay=True)
                row, is_known = kept_row(db, calibration, operator)
                detail = {"calibration_id": row.id, "sha256": row.sha256, "camera": row.camera, "is_new": not is_known}
                detail |= {"format": converted.format, "notes": list(converted.notes)}
                audit.append(db, Event(actor=operator, action=ACTION, detail=detail))
                answer = schemas.UploadedCalibration.model_validate(
                    {**_calibration(row).model_dump(), "format": converted.format, "notes": list(converted.notes)}
                )
                keep_answer(db, ACTION, key, body, answer)
            return IdempotentAnswer(answer=answer, is_replay=is_known)

    def page(self, cursor: str | None, limit: int, camera: str | None = None) -> schemas.CalibrationPage:
        """List them, newest first."""
        with self._database.read() as db:
            rows, next_cursor = queries.calibration_page(db, cursor, limit, camera)
            return schemas.CalibrationPage(items=[_calibration(row) for row in rows], next_cursor=next_cursor)

    def detail(self, calibration_id: str) -> schemas.CalibrationDetail:
        """Read one."""
        with self._database.read() as db:
            row = queries.calibration_row(db, calibration_id)
            document = json.loads(row.document)
            return schemas.CalibrationDetail(**_calibration(row).model_dump(), document=document)


def kept_row(db: Session, calibration: Calibration, operator: str) -> tuple[CalibrationRow, bool]:
    """Find or insert a calibration's row, by its content; the second value is whether it existed."""
    row = db.scalar(select(CalibrationRow).where(CalibrationRow.sha256 == calibration.sha256))
    if row is not None:
        return row, True
    row = CalibrationRow(
        id=uuid.uuid4().hex,
        sha256=calibration.sha256,
        camera=calibration.camera,
        document=calibration.to_json(),
        uploaded_by=operator,
        created_at=datetime.now(UTC),
    )
    db.add(row)
    db.flush()
    return row, False


def _calibration(row: CalibrationRow) -> schemas.Calibration:
    return schemas.Calibration(
        id=row.id,
        sha256=row.sha256,
        camera=row.camera,
        uploaded_by=row.uploaded_by,
        created_at=row.created_at,
    )
