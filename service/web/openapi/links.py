"""OpenAPI links: an id in an answer is a parameter of other operations."""

from collections.abc import Set
from typing import Any

SESSION, MODEL, CALIBRATION, RUN = "session_id", "model_id", "calibration_id", "run_id"
OF_SESSION = (
    "read_session",
    "start_session",
    "set_reference",
    "sign_position",
    "countersign",
    "read_arming",
    "arm_session",
    "hold_beam",
    "release_beam",
    "disarm_session",
    "acknowledge_fault",
    "correct_baseline",
    "set_window",
    "note_presence",
    "stop_session",
    "retrain_model",
    "apply_model",
    "list_session_models",
    "list_transitions",
    "export_samples",
    "read_picture",
    "read_mesh",
)
OF_MODEL = ("read_model", "read_spectrum", "read_quality_maps", "activate_model")
OF_RUN = ("read_qa_run", "cancel_qa_run", "read_qa_report")
OF_PERSON = ("read_user", "change_user", "list_user_logins")
OF_KEY = ("read_key", "revoke_key")
LINKS: dict[str, tuple[tuple[str, str, tuple[str, ...]], ...]] = {
    "create_session": (("id", SESSION, OF_SESSION),),
    "start_session": (("id", SESSION, OF_SESSION),),
    "read_session": (("id", SESSION, OF_SESSION), ("calibration_id", CALIBRATION, ("read_calibration",))),
    "list_sessions": (
        ("items/0/id", SESSION, ("read_session", "list_transitions", "export_samples", "list_session_models")),
    ),
    "list_session_models": (("items/0/id", MODEL, OF_MODEL),),
    "upload_calibration": (("id", CALIBRATION, ("read_calibration",)),),
    "list_calibrations": (("items/0/id", CALIBRATION, ("read_calibration",)),),
    "start_qa_run": (("id", RUN, OF_RUN),),
    "list_qa_runs": (("items/0/id", RUN, OF_RUN),),
    "add_user": (("name", "name", OF_PERSON),),
    "create_key": (("id", "key_id", OF_KEY),),
    "list_my_logins": (("items/0/id", "login_id", ("end_my_login",)),),
    "prepare_session": (("id", SESSION, OF_SESSION),),
    "import_plan": (("id", "plan_id", ("read_plan", "prepare_session")),),
}
"""Operation -> (place in its answer, parameter, operations that take the parameter)."""


def add_links(operation: dict[str, Any], there_are: Set[str]) -> None:
    """Add an operation's links to its first 2xx answer; links to operations that do not exist are left out."""
    made: dict[str, Any] = {}
    for place, parameter, targets in LINKS.get(operation["operationId"], ()):
        for target in sorted(there_are & set(targets)):
            made[target] = {"operationId": target, "parameters": {parameter: f"$response.body#/{place}"}}
    if made:
        status = min(status for status in operation["responses"] if status.startswith("2"))
        operation["responses"][status]["links"] = made
