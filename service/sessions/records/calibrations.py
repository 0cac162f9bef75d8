"""Camera calibrations: checked by the engine's parser, stored under the hash of their content.

The recordings that a session may play, as a person chooses them from a list.

Motion models as records; the running session's are trained by its engine and stored by its writer.
"""

import hashlib
import json
import uuid
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from engine.calibration import Calibration
from engine.calibration.formats import read_upload
from engine.capture import OniReader
from engine.core.errors import RecordingError
from engine.core.frames import FloatArray
from service.core.errors import BoundError, NotFoundError
from service.core.schemas import records as schemas
from service.core.schemas.records import (
    Model,
    ModelPage,
    ModelSimilarity,
    QualityMaps,
    Recording,
    RecordingPage,
    Spectrum,
)
from service.engine_host.equipment import EquipmentSlot
from service.engine_host.site_limits.calibrations import refuse_reserved_name
from service.engine_host.site_limits.recording_folders import find_recording, recording_paths
from service.storage import audit
from service.storage.audit import Event
from service.storage.audit.log import AuditLog
from service.storage.database import queries
from service.storage.database.engine import Database
from service.storage.database.idempotency import CallersKey, IdempotentAnswer, InProgress, earlier_answer, keep_answer
from service.storage.database.tables import CalibrationRow, ModelRow, SessionRow
from service.storage.files.motion_models import ModelStore

ACTION = "calibration.upload"
_US_PER_S = 1_000_000
_NOT_READ = dict.fromkeys(("bytes", "modified_at", "seconds", "width_px", "height_px", "fps", "has_color", "mirrored"))
MAP_STRIDE = 4
"""Rows and columns of the region's grid between two values of a model's maps."""
DECIMALS = 2


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


class RecordingList:
    """Lists the files of the site's recording folders, read at each call: files come and go without the service."""

    def __init__(self, folders: tuple[Path, ...]) -> None:
        self._folders = folders

    def page(self, cursor: str | None, limit: int) -> RecordingPage:
        """Return the recordings in order of their paths, after the one whose key is ``cursor``.

        Raises
        ------
        BoundError
            That file has been removed meanwhile: where the page begins is not known.
        """
        paths = recording_paths(self._folders)
        keys = [None, *map(_key, paths)]
        if cursor not in keys:
            msg = "the last recording of the page before was removed: list from the first page again"
            raise BoundError(msg, field="cursor", value=cursor or "", bound="of a recording that exists")
        first = keys.index(cursor)
        end = min(first + limit, len(paths))
        items = [self._described(path) for path in paths[first:end]]
        return RecordingPage(items=items, next_cursor=keys[end] if end < len(paths) else None)

    def _described(self, path: str) -> Recording:
        try:
            return _read(path, find_recording(path, self._folders))
        except (BoundError, NotFoundError, RecordingError, OSError) as error:
            return Recording(path=path, problem=str(error), **_NOT_READ)


def _key(path: str) -> str:
    """Identify a path of any length in a cursor, whose length is bounded."""
    return hashlib.sha256(path.encode()).hexdigest()[:32]


def _read(path: str, file: Path) -> Recording:
    with OniReader(file) as reader:
        depth, last_us = reader.depth, reader.header.last_timestamp_us
        return Recording(
            path=path,
            bytes=reader.file_bytes,
            modified_at=datetime.fromtimestamp(file.stat().st_mtime, UTC),
            seconds=None if last_us is None else last_us / _US_PER_S,
            width_px=depth.size_px[0],
            height_px=depth.size_px[1],
            fps=depth.fps,
            has_color=reader.color is not None,
            mirrored=reader.mirrored,
            problem=reader.impossible_start(),
        )


class ModelRepository:
    """Lists and reads motion models."""

    def __init__(self, database: Database, equipment: EquipmentSlot, store: ModelStore) -> None:
        self._database = database
        self._equipment = equipment
        self._store = store

    def page(self, session_id: str, cursor: str | None, limit: int) -> ModelPage:
        """List a session's models, newest first."""
        with self._database.read() as db:
            session = queries.session_row(db, session_id)
            rows, next_cursor = queries.model_page(db, session_id, cursor, limit)
            return ModelPage(items=[self._model(row, session) for row in rows], next_cursor=next_cursor)

    def get(self, model_id: str) -> Model:
        """Read one."""
        with self._database.read() as db:
            row = queries.model_row(db, model_id)
            return self._model(row, queries.session_row(db, row.session_id))

    def spectrum(self, model_id: str) -> Spectrum:
        """Return the share of the motion that each component explains."""
        with self._database.read() as db:
            row = queries.model_row(db, model_id)
            return Spectrum(model_id=row.id, share=json.loads(row.spectrum))

    def quality_maps(self, model_id: str) -> QualityMaps:
        """Return the maps of a model's quality; raise ModelError where its file is missing or damaged."""
        with self._database.read() as db:
            row = queries.model_row(db, model_id)
        model = self._store.load(row.sha256)
        mean_mm = model.mean_mm[::MAP_STRIDE, ::MAP_STRIDE]
        raw_mm, surface_mm, residual_mm = model.sample_raw_mm, model.sample_reconstructed_mm, model.residual_map_mm
        return QualityMaps.model_validate(
            {
                "model_id": row.id,
                "measured_mm": None if raw_mm is None else _rows(mean_mm - raw_mm),
                "reconstructed_mm": None if surface_mm is None else _rows(mean_mm - surface_mm),
                "residual_mm": None if residual_mm is None else _rows(residual_mm),
            }
        )

    def similarity(self, model_id: str, other_id: str) -> ModelSimilarity:
        """Compare two models of a patient, on the grid that the markers span.

        Raises
        ------
        NotFoundError, ModelError
            One of them does not exist, or its file is missing or damaged.
        BoundError
            They are of different patients.
        """
        with self._database.read() as db:
            rows = [queries.model_row(db, one) for one in (model_id, other_id)]
            patients = {queries.session_row(db, row.session_id).patient_reference for row in rows}
        if len(patients) > 1:
            bound = "a model of the same patient"
            raise BoundError(f"other must be {bound}", field="other", value=other_id, bound=bound)
        model, other = (self._store.load(row.sha256) for row in rows)
        ours, theirs = (one.components.reshape(len(one.components), -1).astype(np.float64) for one in (model, other))
        cosines = ours @ theirs.T
        variance_mm2 = model.eigenvalues_mm2[: len(ours)]
        shift_mm = (model.mean_mm - other.mean_mm)[model.known & other.known].astype(np.float64)
        first_cosine = np.clip(np.linalg.norm(cosines[0]), 0.0, 1.0)
        return ModelSimilarity(
            model_id=model_id,
            other_id=other_id,
            explained_share=round(float(variance_mm2 @ (cosines**2).sum(axis=1) / variance_mm2.sum()), 4),
            first_angle_deg=round(float(np.degrees(np.arccos(first_cosine))), 2),
            shift_mm=round(float(shift_mm.mean()), DECIMALS) if len(shift_mm) else None,
            shape_mm=round(float(shift_mm.std()), DECIMALS) if len(shift_mm) else None,
        )

    def _model(self, row: ModelRow, session: SessionRow) -> Model:
        made = json.loads(row.provenance)
        origin = made.get("origin") or {}
        running = self._equipment.of(row.session_id)
        return Model(
            id=row.id,
            session_id=row.session_id,
            number=row.number,
            sha256=row.sha256,
            components=row.components,
            is_active=running is not None and running.writer.active_model_id == row.id,
            created_at=row.created_at,
            patient_reference=session.patient_reference,
            calibration_id=session.calibration_id,
            training_frames=made.get("training_frames"),
            cycles=made.get("cycles"),
            source=origin.get("source"),
            software=origin.get("software"),
            quality=made.get("quality"),
            settings=made.get("settings", {}),
        )


def _rows(values_mm: FloatArray) -> list[list[float | None]]:
    """Return rows of numbers; null stands for what is not known."""
    rounded = np.round(values_mm.astype(np.float64), DECIMALS)
    return [[None if value != value else value for value in row] for row in rounded.tolist()]  # noqa: PLR0124 (NaN)
