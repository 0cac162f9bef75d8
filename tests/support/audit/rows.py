"""Audit rows for tests."""

from service.storage import audit
from service.storage.audit import Event
from service.storage.database.engine import Database


def fill(database: Database, rows: int) -> None:
    with database.write() as db:
        for number in range(1, rows + 1):
            audit.append(db, Event(actor="me", action="test", detail={"number": number, "text": "Grüße ☢"}))


SOME, T = "x" * 32, "t"

ROWS = {
    "calibrations": {
        "id": SOME,
        "sha256": "a" * 64,
        "camera": "c",
        "document": "{}",
        "uploaded_by": "me",
        "created_at": "t",
    },
    "sessions": {
        "id": SOME,
        "status": "ended",
        "status_detail": "",
        "patient_reference": "p",
        "plan_id": "p",
        "fraction_id": "f",
        "operator": "me",
        "source": "{}",
        "window": "{}",
        "calibration_id": SOME,
        "is_simulated_beam": 1,
        "created_at": "t",
    },
    "plans": {
        "id": SOME,
        "sop_instance_uid": "1.2.3",
        "sha256": "e" * 64,
        "kind": "RT Plan",
        "label": "l",
        "patient_reference": "p",
        "gating": "none",
        "document": "{}",
        "imported_by": "me",
        "created_at": "t",
    },
    "models": {
        "id": SOME,
        "session_id": SOME,
        "number": 1,
        "sha256": "b" * 64,
        "spectrum": "[]",
        "components": 3,
        "created_at": "t",
    },
    "qa_baselines": {"number": 1, "expected": "{}", "set_by": "me", "reason": "new", "created_at": "t"},
    "qa_runs": {
        "id": SOME,
        "kind": "daily",
        "operator": "me",
        "site": "s",
        "machine": "m",
        "request": "{}",
        "is_simulated": 1,
        "is_simulated_beam": 1,
        "bounds": "{}",
        "software": "1",
        "created_at": "t",
    },
    "qa_results": {
        "run_id": SOME,
        "code": "c",
        "position": 1,
        "unit": "mm",
        "warn": 1.0,
        "fail": 2.0,
        "verdict": "pass",
        "detail": "",
    },
    "qa_outcomes": {
        "run_id": SOME,
        "status": "finished",
        "status_detail": "",
        "series": "{}",
        "sha256": "c" * 64,
        "ended_at": "t",
    },
}

KEPT = [table for table in ROWS if table != "sessions"]

COLUMN = {
    "plans": "label",
    "calibrations": "camera",
    "models": "sha256",
    "qa_baselines": "reason",
    "qa_runs": "site",
} | {
    "qa_results": "detail",
    "qa_outcomes": "series",
}
