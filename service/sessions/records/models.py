"""Motion models as records; the running session's are trained by its engine and stored by its writer."""

import json

from service.core.schemas.models import Model, ModelPage, Spectrum
from service.engine_host.equipment import EquipmentSlot
from service.storage.database import queries
from service.storage.database.engine import Database
from service.storage.database.tables import ModelRow, SessionRow


class ModelRepository:
    """Lists and reads motion models."""

    def __init__(self, database: Database, equipment: EquipmentSlot) -> None:
        self._database = database
        self._equipment = equipment

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
