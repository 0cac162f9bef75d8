"""Camera calibrations: checked by the engine's own parser, kept under the hash of what they say."""

import json
import uuid
from datetime import UTC, datetime

from sqlalchemy import select

from engine.calibration import parse_calibration
from service import audit, schemas
from service.audit import Event
from service.audit_log import AuditLog
from service.db import repository
from service.db.engine import Database
from service.db.models import CalibrationRow
from service.idempotency import earlier_answer, keep_answer
from service.ports import Kept

ACTION = "calibration.upload"


class CalibrationShelf:
    """Stored calibrations."""

    def __init__(self, database: Database, log: AuditLog) -> None:
        self._database = database
        self._log = log

    def upload(self, body: bytes, operator: str, key: str | None) -> Kept[schemas.Calibration]:
        """Check and keep one; the same content again is the same calibration."""
        with self._log.refusals(actor=operator, action=ACTION, detail={"bytes": len(body)}):
            calibration = parse_calibration(body)
            with self._database.write() as db:
                earlier = earlier_answer(db, ACTION, key, body, schemas.Calibration)
                if earlier is not None:
                    return Kept(answer=earlier, is_replay=True)
                row = db.scalar(select(CalibrationRow).where(CalibrationRow.sha256 == calibration.sha256))
                is_known = row is not None
                if row is None:
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
                detail = {"calibration_id": row.id, "sha256": row.sha256, "camera": row.camera, "is_new": not is_known}
                audit.append(db, Event(actor=operator, action=ACTION, detail=detail))
                answer = _calibration(row)
                keep_answer(db, ACTION, key, body, answer)
            return Kept(answer=answer, is_replay=is_known)

    def page(self, cursor: str | None, limit: int) -> schemas.CalibrationPage:
        """List them, newest first."""
        with self._database.read() as db:
            rows, next_cursor = repository.calibration_page(db, cursor, limit)
            return schemas.CalibrationPage(items=[_calibration(row) for row in rows], next_cursor=next_cursor)

    def detail(self, calibration_id: str) -> schemas.CalibrationDetail:
        """Read one."""
        with self._database.read() as db:
            row = repository.calibration_row(db, calibration_id)
            document = json.loads(row.document)
            return schemas.CalibrationDetail(**_calibration(row).model_dump(), document=document)


def _calibration(row: CalibrationRow) -> schemas.Calibration:
    return schemas.Calibration(
        id=row.id,
        sha256=row.sha256,
        camera=row.camera,
        uploaded_by=row.uploaded_by,
        created_at=row.created_at,
    )
