"""Sessions put into a database without an engine."""

from datetime import UTC, datetime

from service.storage.database.tables import CalibrationRow, SessionRow
from tests.support.samples.records import SESSION

BEGUN = datetime(2026, 11, 1, 8, tzinfo=UTC)


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
