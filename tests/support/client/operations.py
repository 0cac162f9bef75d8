"""Which call of the contract each method of the client makes, and which calls no planning system has use for."""

import json
from typing import Any

from tests.support.repository import ROOT

CONTRACT = ROOT / "openapi" / "openapi.json"
LIVE = ROOT / "openapi" / "live.schema.json"

SESSION = "/api/v1/sessions/{session_id}"
OPERATIONS: dict[str, tuple[str, str]] = {
    "log_in": ("POST", "/api/v1/login"),
    "log_out": ("POST", "/api/v1/logout"),
    "change_password": ("POST", "/api/v1/me/password"),
    "me": ("GET", "/api/v1/me"),
    "readiness": ("GET", "/readyz"),
    "devices": ("GET", "/api/v1/devices"),
    "recordings": ("GET", "/api/v1/recordings"),
    "interlocks": ("GET", "/api/v1/interlocks"),
    "upload_calibration": ("POST", "/api/v1/calibrations"),
    "calibrations": ("GET", "/api/v1/calibrations"),
    "read_calibration": ("GET", "/api/v1/calibrations/{calibration_id}"),
    "import_plan": ("POST", "/api/v1/plans"),
    "plans": ("GET", "/api/v1/plans"),
    "read_plan": ("GET", "/api/v1/plans/{plan_id}"),
    "prepare_session": ("POST", "/api/v1/plans/{plan_id}/sessions"),
    "create_session": ("POST", "/api/v1/sessions"),
    "sessions": ("GET", "/api/v1/sessions"),
    "read_session": ("GET", SESSION),
    "start": ("POST", f"{SESSION}/start"),
    "read_arming": ("GET", f"{SESSION}/arming"),
    "set_reference": ("POST", f"{SESSION}/reference"),
    "sign_position": ("POST", f"{SESSION}/position-check"),
    "countersign": ("POST", f"{SESSION}/countersign"),
    "arm": ("POST", f"{SESSION}/arm"),
    "release": ("POST", f"{SESSION}/release"),
    "acknowledge": ("POST", f"{SESSION}/acknowledge"),
    "correct_baseline": ("POST", f"{SESSION}/baseline-correction"),
    "set_window": ("POST", f"{SESSION}/window"),
    "note_presence": ("POST", f"{SESSION}/presence"),
    "hold": ("POST", f"{SESSION}/hold"),
    "disarm": ("POST", f"{SESSION}/disarm"),
    "stop": ("POST", f"{SESSION}/stop"),
    "transitions": ("GET", f"{SESSION}/transitions"),
    "session_models": ("GET", f"{SESSION}/models"),
    "read_model": ("GET", "/api/v1/models/{model_id}"),
    "retrain": ("POST", f"{SESSION}/models/retrain"),
    "apply_model": ("POST", f"{SESSION}/models/apply"),
    "export_samples": ("GET", f"{SESSION}/samples"),
    "read_report": ("GET", f"{SESSION}/report"),
    "export_report": ("GET", f"{SESSION}/report.pdf"),
    "export_waveform": ("GET", f"{SESSION}/waveform.dcm"),
    "export_report_dicom": ("GET", f"{SESSION}/report.dcm"),
    "audit": ("GET", "/api/v1/audit"),
    "verify_audit": ("GET", "/api/v1/audit/verify"),
    "export_audit": ("GET", "/api/v1/audit/export"),
    "qa_status": ("GET", "/api/v1/qa/status"),
    "qa_latency": ("GET", "/api/v1/qa/latency"),
    "qa_checks": ("GET", "/api/v1/qa/checks"),
    "qa_runs": ("GET", "/api/v1/qa/runs"),
    "read_qa_run": ("GET", "/api/v1/qa/runs/{run_id}"),
    "qa_trend": ("GET", "/api/v1/qa/trend"),
    "export_qa_report": ("GET", "/api/v1/qa/runs/{run_id}/report.pdf"),
}
NOT_FOR_PLANNING: dict[str, str] = {
    "/api/v1/login/": "a page's way to log in",
    "/api/v1/me/logins": "a person looks after their own log-ins",
    "/api/v1/users": "people are made by people",
    "/api/v1/keys": "keys are made by people",
    "/api/v1/models/{model_id}/activate": "a physicist decides which model measures",
    "/api/v1/models/{model_id}/spectrum": "a physicist's figure",
    "/api/v1/models/{model_id}/quality-maps": "a physicist's figure",
    "/api/v1/models/{model_id}/similarity": "a physicist's figure",
    "/api/v1/sessions/{session_id}/picture": "for eyes",
    "/api/v1/sessions/{session_id}/mesh": "for eyes",
    "/api/v1/sessions/{session_id}/report.html": "for eyes",
    "/api/v1/sessions/{session_id}/trace": "for eyes",
    "/api/v1/sessions/{session_id}/moment": "for eyes",
    "/api/v1/qa/baseline": "a physicist fixes it",
    "POST /api/v1/qa/runs": "QA permits the beam: a person in the room starts it",
    "POST /api/v1/qa/runs/{run_id}/cancel": "the person who started it",
    "/api/v1/coach/": "a therapist pairs screens at the console",
    "/api/v1/sessions/{session_id}/coaching": "a therapist chooses at the console",
    "/api/v1/sessions/{session_id}/note": "a person notes what they looked at",
    "/api/v1/sessions/{session_id}/signature": "a person signs what they looked at",
    "/api/v1/sessions/{session_id}/send": "a person sends what they looked at",
    "POST /api/v1/sessions/{session_id}/simulation": "a person signs what they looked at",
    "/api/v1/sessions/{session_id}/simulation": "for eyes",
    "/api/v1/pacs": "for people who look after the PACS",
    "/api/v1/machine": "for people who look after the machine",
    "/healthz": "a watchdog's",
    "/metrics": "Prometheus's",
}
"""Beginnings of paths, with a method or without, and why the client leaves them out."""


def contract() -> dict[str, Any]:
    """Read the contract as it is committed."""
    return json.loads(CONTRACT.read_text())


def live_contract() -> dict[str, Any]:
    """Read the contract of the stream."""
    return json.loads(LIVE.read_text())


def is_left_out(method: str, path: str) -> bool:
    """Say whether a call was left out on purpose."""
    return any(f"{method} {path}".startswith(one) or path.startswith(one) for one in NOT_FOR_PLANNING)
