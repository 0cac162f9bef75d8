"""Learned motion models, as records; the running session's are made by its engine and kept by its writer."""

import json

from service.db import repository
from service.db.engine import Database
from service.db.models import ModelRow, SessionRow
from service.model_schemas import Model, ModelPage, Spectrum
from service.room import Room


class ModelShelf:
    """Stored motion models."""

    def __init__(self, database: Database, room: Room) -> None:
        self._database = database
        self._room = room

    def page(self, session_id: str, cursor: str | None, limit: int) -> ModelPage:
        """List a session's models, newest first."""
        with self._database.read() as db:
            session = repository.session_row(db, session_id)
            rows, next_cursor = repository.model_page(db, session_id, cursor, limit)
            return ModelPage(items=[self._model(row, session) for row in rows], next_cursor=next_cursor)

    def get(self, model_id: str) -> Model:
        """Read one."""
        with self._database.read() as db:
            row = repository.model_row(db, model_id)
            return self._model(row, repository.session_row(db, row.session_id))

    def spectrum(self, model_id: str) -> Spectrum:
        """Tell how much each component explains."""
        with self._database.read() as db:
            row = repository.model_row(db, model_id)
            return Spectrum(model_id=row.id, share=json.loads(row.spectrum))

    def _model(self, row: ModelRow, session: SessionRow) -> Model:
        made = json.loads(row.provenance)
        origin = made.get("origin") or {}
        running = self._room.of(row.session_id)
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
