"""Motion models as records; the running session's are trained by its engine and stored by its writer."""

import json

import numpy as np

from engine.core.frames import FloatArray
from service.core.schemas.records import Model, ModelPage, QualityMaps, Spectrum
from service.engine_host.equipment import EquipmentSlot
from service.storage.database import queries
from service.storage.database.engine import Database
from service.storage.database.tables import ModelRow, SessionRow
from service.storage.files.motion_models import ModelStore

MAP_STRIDE = 4
"""Rows and columns of the region's grid between two values of a model's maps."""
DECIMALS = 2


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
