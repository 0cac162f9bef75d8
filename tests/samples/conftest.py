"""A service on a fake engine, as tests/service has it; and a database with sessions that were never closed."""

from datetime import UTC, datetime

import pytest

from service.db.models import CalibrationRow, SessionRow
from service.samples.shelf import SampleShelf
from tests.samples.records import SESSION
from tests.service.conftest import (
    calibration_id,
    calibration_text,
    client,
    engine,
    running,
    session_body,
    session_id,
    settings,
)

__all__ = [
    "calibration_id",
    "calibration_text",
    "client",
    "engine",
    "running",
    "session_body",
    "session_id",
    "settings",
]

BEGUN = datetime(2026, 11, 1, 8, tzinfo=UTC)


@pytest.fixture
def shelf(tmp_path):
    shelf = SampleShelf(tmp_path / "data" / "samples")
    shelf.folder.mkdir(parents=True)
    return shelf


def add_session(database, session_id=SESSION, *, status="running", ended_at=None):
    """Put a session into the database as a process that was killed left it."""
    with database.write() as db:
        if db.get(CalibrationRow, "cal") is None:
            made = {"id": "cal", "sha256": "c" * 64, "camera": "cam", "document": "{}", "uploaded_by": "me"}
            db.add(CalibrationRow(**made, created_at=BEGUN))
            db.flush()
        db.add(
            SessionRow(
                id=session_id,
                status=status,
                status_detail="",
                patient_reference="P-0001",
                plan_id="1",
                fraction_id="1",
                operator="me",
                source='{"kind": "device", "uri": null}',
                window="{}",
                calibration_id="cal",
                is_simulated_beam=True,
                created_at=BEGUN,
                started_at=BEGUN,
                ended_at=ended_at,
            )
        )
