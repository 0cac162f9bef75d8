"""The catalogue of problems: every code, when it is returned and what helps.

docs/4-integrate/problems.md is made from it.

Codes, statuses and titles come from the table in `service.core.errors`, "when" from the docstring
of the error's class; only what to do is written here.
"""

import inspect
import sys
from collections.abc import Mapping
from dataclasses import dataclass

from engine.core.errors import TidegateError
from service.web.problems.table import HTTP_CODES, STATUS_OF, STORAGE_CODE, code_of, status_of

WHAT_TO_DO: Mapping[str, str] = {
    "audit_busy": "Wait until the other verification has ended, then continue from `checked_to`.",
    "bad_request": "Send the body as JSON in UTF-8.",
    "beam_line_failed": "Check the beam line's wiring and its converter; the beam is held meanwhile.",
    "beam_line_mismatch": "Treat the beam line as defective: its read-back differs from the command. "
    "See docs/3-operate/beam.md.",
    "body_too_large": "Send a smaller body; `bound` is the limit.",
    "calibration_invalid": "Correct the field of the calibration that `field` names, or calibrate the camera again.",
    "camera_mismatch": "Connect the camera that was calibrated, or calibrate this one.",
    "command_refused": "Read `detail`: it names what is missing (a model, a reference, a fresh frame) and what to do.",
    "engine_missing": "Retry after a few seconds; if it persists, read the service's log.",
    "engine_timeout": "The command was cancelled. Read the session, then retry.",
    "head_direction_missing": "See on which side of the picture the patient's head lies, and send it as "
    "`head_direction` with the arming. If the session has another or none, create another session.",
    "headers_too_large": "Send fewer or shorter headers; cookies are included in the limit.",
    "host_refused": "Use one of the service's host names, or have the site allow this one.",
    "idempotency_in_progress": "Repeat the same request with the same key after `Retry-After`.",
    "idempotency_key_reused": "Use a new key for a new request.",
    "internal_error": "Report `X-Request-ID` to the administrator; the service's log has the error.",
    "invalid_value": "Correct `field` so that it meets `bound`; `errors` lists all wrong fields.",
    "journal_unavailable": "No session can start. Have the administrator free memory and disk space.",
    "last_admin": "Give another person the administrator role first.",
    "local_login_refused": "Log in at the identity provider.",
    "locked_out": "Wait for the time in `Retry-After`.",
    "login_busy": "Retry after a second.",
    "login_failed": "Check name and password.",
    "media_type": "Send the body with the Content-Type in `bound`.",
    "mesh_missing": "Retry when the session runs and the patient is measured.",
    "method_not_allowed": "Use one of the methods that `Allow` lists.",
    "model_invalid": "Train a new model.",
    "model_mismatch": "Choose a model of this patient and this calibration, or train a new one.",
    "name_taken": "Choose another name. If the answer to an earlier request was lost, look the name "
    "up: it may exist already.",
    "not_acceptable": "Request a media type that `bound` lists, or leave `Accept` out.",
    "not_found": "Check the id or the path; the list calls return the existing ids.",
    "not_implemented": "Send the body with Content-Length or chunked; no other Transfer-Encoding is supported.",
    "not_logged_in": "Log in, or send a valid API key.",
    "openni_missing": "Have the administrator install the camera's SDK (OpenNI2); recordings work without it.",
    "operator_mismatch": "Leave `operator` out, or log in as that person.",
    "pairing_refused": 'Show a new code at the console ("Patient screen") and enter it within two minutes.',
    "origin_refused": "Browsers: call from this service's own page. Machines: send an API key and no cookie.",
    "outside_user": "Change the account at the identity provider.",
    "password_change_due": "Change the password first.",
    "permission_missing": "Ask an administrator for the permission in `bound`.",
    "person_required": "Have a person log in and do this at the page; no key can.",
    "fraction_done": "Choose the next fraction; a person may repeat one with `repeats_fraction` and a reason.",
    "override_needs_person": "Have a person create this session: an API key cannot override a plan.",
    "plan_busy": "Repeat the request after `Retry-After`.",
    "plan_conflict": "Compare both plans: one was changed and kept its UID. Export it again under a new UID.",
    "plan_contradicted": (
        "Export the correct plan under a new UID, or have a person give the reason in `overrides_contradiction`."
    ),
    "plan_gating": "Use a window of the plan's technique, or have a person give the reason in `overrides_plan_gating`.",
    "plan_invalid": "Correct the element that `field` names in the planning system, and export the plan again.",
    "plan_not_dicom": "Send the exported file unchanged, with the type `application/dicom`.",
    "plan_position": "Compare patient, plan and `TIDEGATE_GANTRY_SIDE`. Only HFS and FFS are supported, in one session "
    "only one of them.",
    "plan_rejected": "Use the approved plan.",
    "plan_too_complex": "Export only the plan; `bound` is the limit.",
    "plan_truncated": "Export or send the file again: its end is missing.",
    "plan_wrong_kind": "Export the RT Plan or RT Ion Plan itself, not an object that refers to it.",
    "picture_missing": "Retry when the session runs and a frame has arrived.",
    "position_unchecked": "Read the session's `position_check`. A person sets the reference, looks at the six figures, "
    "and signs them with `POST .../position-check`; beyond the tolerance with a `reason`. A key cannot.",
    "precondition_failed": "Read the resource again, check the changes, and send the new ETag; "
    "`bound` is the present one.",
    "camera_latency": "`detail` names what is missing: measure the camera's latency (`tidegate qa latency`), or raise "
    "`TIDEGATE_CAMERA_LATENCY_MS`.",
    "qa_active": "Wait until the QA run has ended, or cancel it.",
    "qa_code": "At the machine, run `tidegate qa code` for your name, and send the displayed code within five minutes.",
    "qa_overdue": "Do the daily QA.",
    "qa_state": "Read the run; its status decides which calls are allowed.",
    "recording_unreadable": "Choose another recording; `detail` names the error in this one.",
    "countersignature_missing": "A second person looks at `GET .../arming` and signs its `state` with "
    "`POST .../countersign`; another person arms. A key cannot sign.",
    "reason_missing": "Send `reason`: why this patient has another window.",
    "second_person": "Send name and password of another person who may set the reference and whose password is not "
    "due for a change; people of an identity provider sign from their own log-in.",
    "reference_distance": "See whether the patient has moved, and put the patient back. If the position is meant, a "
    "person who may arm sends the same call with a `reason`; a key cannot.",
    "request_timeout": "Send the complete request without pauses.",
    "samples_removed": "The samples exceeded the site's retention time. A backup may have them.",
    "service_stopping": "Wait until the service is ready again.",
    "session_active": "Stop the other session first.",
    "session_state": "Read the session; its status decides which calls are allowed.",
    "source_lost": "Check the camera and its cable.",
    "source_unusable": "Read `detail`; create another session with a working source.",
    "storage_low": "Have the administrator free disk space; `bound` is the amount needed.",
    "storage_unavailable": "The request may have been carried out: check, then retry. With an "
    "`Idempotency-Key` retrying is safe.",
    "storage_unwritable": "Have the administrator check the disk.",
    "stream_full": "Connect again after `Retry-After`, or have the site allow more clients.",
    "training_failed": "Train again; the model in use stays.",
    "training_refused": "Read `detail`, let the patient breathe quietly, and train again.",
    "url_too_long": "Shorten the path and the query.",
    "wrong_password": "Send the present password.",
}
USUAL = {
    "bad_request": "The body cannot be parsed.",
    "body_too_large": "The body is larger than the site's limit.",
    "request_timeout": "The request or its body did not arrive within the site's time limit.",
    "url_too_long": "Path and query are longer than the site's limit.",
    "headers_too_large": "The headers exceed the site's limit in size or number.",
    "not_implemented": "The Transfer-Encoding of the body is not supported.",
    "method_not_allowed": "The path exists, but not for this method.",
    "host_refused": "The Host header names a host that this service does not serve.",
    "internal_error": "An unexpected error; the answer contains no internals, the service's log does.",
    STORAGE_CODE: "The database does not answer, or is locked for too long.",
    "http_error": "The request violates HTTP.",
}
TITLES = {
    "bad_request": "The body cannot be parsed",
    "body_too_large": "The body is too large",
    "request_timeout": "The request took too long",
    "url_too_long": "The URL is too long",
    "headers_too_large": "The headers are too large",
    "not_implemented": "The Transfer-Encoding is not supported",
    "method_not_allowed": "Method Not Allowed",
    "host_refused": "This host name is not served",
    "internal_error": "Internal error",
}
WITH_FIELD = frozenset({422, 409, 412})


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One code."""

    code: str
    status: int
    title: str
    when: str
    what_to_do: str


def _entries() -> dict[str, Entry]:
    modules = {sys.modules[kind.__module__] for kind in STATUS_OF if issubclass(kind, TidegateError)}
    kinds = {
        kind
        for module in modules
        for _, kind in inspect.getmembers(module, inspect.isclass)
        if issubclass(kind, TidegateError) and any(base in STATUS_OF for base in kind.__mro__)
    }
    entries: dict[str, Entry] = {}
    for kind in sorted(kinds, key=lambda kind: (len(kind.__mro__), kind.__name__)):
        code = code_of(kind)
        title = next(STATUS_OF[base][1] for base in kind.__mro__ if base in STATUS_OF)
        when = (inspect.getdoc(kind) or "").partition("\n")[0]
        entries.setdefault(code, _entry(code, status_of(kind), title, when))
    statuses = {code: status for status, code in HTTP_CODES.items()} | {"internal_error": 500, STORAGE_CODE: 503}
    for code, status in statuses.items():
        title = TITLES.get(code, "The database does not answer")
        entries.setdefault(code, _entry(code, status, title, USUAL.get(code, "")))
    return dict(sorted(entries.items()))


def _entry(code: str, status: int, title: str, when: str) -> Entry:
    return Entry(code=code, status=status, title=title, when=when, what_to_do=WHAT_TO_DO.get(code, ""))


CATALOGUE: Mapping[str, Entry] = _entries()
