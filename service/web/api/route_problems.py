"""The problems that each route documents, by code, beside those of any call (`service.web.openapi`).

As in `service.access.request.rules`, a route stands by its method and its path, here below ``/api/v1``.
"""

from collections.abc import Iterable, Mapping
from typing import Any

from fastapi.routing import APIRoute
from starlette.routing import BaseRoute

from service.web.api import problem_answer
from service.web.problems.catalogue import CATALOGUE

SESSION, PLAN, MODEL, QA, ME, PERSON = (
    *("/sessions/{session_id}", "/plans/{plan_id}", "/models/{model_id}", "/qa/runs/{run_id}", "/me", "/users/{name}"),
)
COMMAND = "not_found operator_mismatch session_state command_refused engine_timeout beam_line_failed"
MOVE = f"{COMMAND} reference_distance invalid_value"
TRAIN = (
    "not_found operator_mismatch session_state command_refused engine_timeout model_invalid model_mismatch "
    "training_refused"
)
SOURCE = (
    "not_found invalid_value operator_mismatch recording_unreadable session_active qa_active source_lost "
    "openni_missing service_stopping"
)
OPEN = f"{SOURCE} model_mismatch command_refused engine_missing"
REPORT = "not_found session_state samples_removed"

PROBLEMS: Mapping[tuple[str, str], str] = {
    ("GET", "/audit/verify"): "not_found audit_busy",
    ("GET", "/audit/export"): "not_found",
    ("POST", "/calibrations"): "invalid_value calibration_invalid operator_mismatch",
    ("GET", "/calibrations/{calibration_id}"): "not_found",
    ("POST", "/coach/pair"): "pairing_refused locked_out",
    ("POST", "/coach/screens/{screen_id}/end"): "not_found",
    ("GET", f"{SESSION}/coaching"): "not_found session_state",
    ("PUT", f"{SESSION}/coaching"): "not_found session_state invalid_value operator_mismatch",
    ("GET", "/devices"): "engine_missing",
    ("POST", "/keys"): "invalid_value name_taken",
    ("GET", "/keys/{key_id}"): "not_found",
    ("POST", "/keys/{key_id}/revoke"): "not_found",
    ("GET", "/live/events"): "stream_full",
    ("POST", "/login"): "invalid_value login_failed local_login_refused locked_out login_busy",
    ("GET", "/login/oidc/return"): "invalid_value",
    ("POST", f"{ME}/password"): "not_found invalid_value wrong_password outside_user locked_out login_busy",
    ("GET", f"{ME}/logins"): "not_found",
    ("POST", f"{ME}/logins/{{login_id}}/end"): "not_found",
    ("GET", f"{SESSION}/models"): "not_found",
    ("POST", f"{SESSION}/models/retrain"): TRAIN,
    ("POST", f"{SESSION}/models/apply"): TRAIN,
    ("GET", MODEL): "not_found",
    ("GET", f"{MODEL}/spectrum"): "not_found",
    ("GET", f"{MODEL}/quality-maps"): "not_found model_invalid",
    ("GET", f"{MODEL}/similarity"): "not_found invalid_value model_invalid",
    ("POST", f"{MODEL}/activate"): TRAIN,
    ("POST", "/plans"): (
        "operator_mismatch plan_invalid plan_not_dicom plan_too_complex plan_truncated plan_wrong_kind plan_conflict "
        "plan_busy"
    ),
    ("GET", "/plans"): "invalid_value",
    ("GET", PLAN): "not_found",
    ("POST", f"{PLAN}/sessions"): (
        f"{OPEN} storage_low override_needs_person fraction_done plan_contradicted plan_gating plan_position "
        "plan_rejected"
    ),
    ("POST", "/qa/runs"): f"{SOURCE} calibration_invalid beam_line_failed qa_code",
    ("GET", QA): "not_found",
    ("POST", f"{QA}/cancel"): "not_found qa_state",
    ("GET", f"{QA}/report.pdf"): "not_found qa_state",
    ("PUT", "/qa/baseline"): "not_found invalid_value operator_mismatch qa_active qa_state",
    ("GET", "/recordings"): "invalid_value",
    ("POST", "/sessions"): f"{OPEN} storage_low",
    ("GET", SESSION): "not_found",
    ("POST", f"{SESSION}/start"): (
        f"{OPEN} session_state calibration_invalid source_unusable model_invalid beam_line_failed journal_unavailable "
        "storage_unwritable"
    ),
    ("POST", f"{SESSION}/arm"): (
        f"{COMMAND} head_direction_missing position_unchecked qa_overdue camera_latency reference_distance "
        "countersignature_missing"
    ),
    ("GET", f"{SESSION}/arming"): "not_found",
    ("POST", f"{SESSION}/disarm"): "not_found session_state command_refused engine_timeout beam_line_failed",
    ("POST", f"{SESSION}/reference"): MOVE,
    ("POST", f"{SESSION}/position-check"): f"{COMMAND} position_unchecked",
    ("POST", f"{SESSION}/countersign"): (
        f"{COMMAND} countersignature_missing second_person locked_out local_login_refused login_busy"
    ),
    ("POST", f"{SESSION}/acknowledge"): COMMAND,
    ("POST", f"{SESSION}/hold"): "not_found session_state command_refused engine_timeout beam_line_failed",
    ("POST", f"{SESSION}/release"): COMMAND,
    ("POST", f"{SESSION}/presence"): "not_found operator_mismatch person_required session_state",
    ("POST", f"{SESSION}/baseline-correction"): MOVE,
    ("POST", f"{SESSION}/window"): f"{MOVE} reason_missing",
    ("POST", f"{SESSION}/stop"): "not_found session_state",
    ("GET", f"{SESSION}/samples"): REPORT,
    ("GET", f"{SESSION}/trace"): f"{REPORT} invalid_value",
    ("GET", f"{SESSION}/moment"): REPORT,
    ("GET", f"{SESSION}/report"): REPORT,
    ("POST", f"{SESSION}/note"): f"{REPORT} operator_mismatch",
    ("POST", f"{SESSION}/signature"): f"{REPORT} operator_mismatch signer_unconfirmed locked_out login_busy",
    ("GET", f"{SESSION}/report.pdf"): REPORT,
    ("GET", f"{SESSION}/report.html"): REPORT,
    ("GET", f"{SESSION}/waveform.dcm"): f"{REPORT} invalid_value",
    ("GET", f"{SESSION}/report.dcm"): f"{REPORT} invalid_value",
    ("POST", f"{SESSION}/send"): f"{REPORT} operator_mismatch",
    (
        "POST",
        f"{SESSION}/simulation",
    ): f"{REPORT} invalid_value operator_mismatch signer_unconfirmed locked_out login_busy",
    ("GET", f"{SESSION}/simulation"): "not_found",
    ("GET", f"{SESSION}/picture"): "not_found picture_missing",
    ("GET", f"{SESSION}/mesh"): "not_found mesh_missing",
    ("GET", f"{SESSION}/transitions"): "not_found",
    ("POST", "/users"): "invalid_value name_taken login_busy",
    ("GET", PERSON): "not_found",
    ("PATCH", PERSON): "not_found invalid_value last_admin outside_user login_busy",
    ("GET", f"{PERSON}/logins"): "not_found",
    ("POST", f"{PERSON}/logins/{{login_id}}/end"): "not_found",
}


def document_problems(routes: Iterable[BaseRoute]) -> None:
    """Add to each route the answers with its problems."""
    for route in routes:
        if isinstance(route, APIRoute):
            codes = " ".join(PROBLEMS.get((method, route.path), "") for method in route.methods or ())
            route.responses = {**route.responses, **_answers(codes)}


def _answers(codes: str) -> dict[int | str, dict[str, Any]]:
    of_status: dict[int, set[str]] = {}
    for code in codes.split():
        of_status.setdefault(CATALOGUE[code].status, set()).add(code)
    return {status: problem_answer(status, found) for status, found in sorted(of_status.items())}
