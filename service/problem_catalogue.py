"""The catalogue of problems: every code there is, when it comes, and what helps; docs/problems.md is made from it.

Codes, statuses and titles come from the table in `service.errors`, "when" from what the error's class says of itself;
only what to do is written here.
"""

import inspect
import sys
from collections.abc import Mapping
from dataclasses import dataclass

from engine.errors import TidegateError
from service.problems import HTTP_CODES, PROBLEM_TYPE, STATUS_OF, STORAGE_CODE, code_of, status_of

WHAT_TO_DO: Mapping[str, str] = {
    "audit_busy": "Wait until the other walk has ended, or go on from `checked_to` later.",
    "bad_request": "Send a body that is JSON in UTF-8.",
    "beam_line_failed": "Look at the beam line's wiring and its converter; the beam is held meanwhile.",
    "beam_line_mismatch": "Treat the line as broken: it reads back otherwise than it was told. docs/beam.md.",
    "body_too_large": "Send less; the bound is named.",
    "calibration_invalid": "Correct the named field of the calibration, or calibrate anew.",
    "command_refused": "Read `detail`: it says what is missing (a model, a reference, a fresh frame) and what helps.",
    "engine_missing": "Ask again in a few seconds; where it stays so the service's log says why.",
    "engine_timeout": "The command was withdrawn. Read the session, then ask again.",
    "headers_too_large": "Send fewer or shorter headers; cookies count.",
    "host_refused": "Call the service by one of its names, or have the site allow this one.",
    "idempotency_in_progress": "Send the same request with the same key again after `Retry-After`.",
    "idempotency_key_reused": "Use a new key for a new request.",
    "internal_error": "Tell whoever administers the service, with `X-Request-ID`: its log says what happened.",
    "invalid_value": "Correct `field` so that it is within `bound`; `errors` lists all of them.",
    "journal_unavailable": "Nothing may start: have the administrator make room in memory and on the disk.",
    "last_admin": "Give somebody else the role of an administrator first.",
    "local_login_refused": "Log in at the identity provider.",
    "locked_out": "Wait for as long as `Retry-After` says.",
    "login_busy": "Try again in a second.",
    "login_failed": "Check name and password; nothing tells which of them is wrong.",
    "media_type": "Send the body with the Content-Type that is named.",
    "mesh_missing": "Ask again once the session runs and has a reference.",
    "method_not_allowed": "Use one of the methods that `Allow` lists.",
    "model_invalid": "Learn a new model.",
    "model_mismatch": "Choose a model of this patient and this calibration, or learn one.",
    "name_taken": "Choose another name. After a lost answer: it was done; look it up.",
    "not_acceptable": "Ask for a media type that the call has, or leave `Accept` out.",
    "not_found": "Check the id or the path; lists tell what there is.",
    "not_implemented": "Send the body plain or chunked; no other Transfer-Encoding is known.",
    "not_logged_in": "Log in, or send a key that is valid.",
    "openni_missing": "Have the administrator install the OpenNI2 runtime; recordings need none.",
    "operator_mismatch": "Leave `operator` out, or log in as that person.",
    "origin_refused": "Browsers: call from the page that is served here. Machines: send a key, and no cookie.",
    "outside_user": "Change the person at the identity provider.",
    "password_change_due": "Change the password first.",
    "permission_missing": "Ask an administrator for the permission in `bound`.",
    "fraction_done": "Choose the next fraction; a person may repeat one with `repeats_fraction` and the reason.",
    "override_needs_person": "Have a person make this session: a machine does not go against a plan.",
    "plan_busy": "Send it again after `Retry-After`.",
    "plan_conflict": "Look at both plans: one of them was changed and kept its UID. Export it anew under a new one.",
    "plan_contradicted": (
        "Export the right one of both under a new UID, or have a person say why (`overrides_contradiction`)."
    ),
    "plan_gating": "Ask for a window of the plan's technique, or have a person say why not (`overrides_plan_gating`).",
    "plan_invalid": "Correct the element that `field` names where the plan was made, and export it again.",
    "plan_not_dicom": "Send the file as it was exported, with the type `application/dicom`.",
    "plan_rejected": "Take the plan that was approved instead.",
    "plan_too_complex": "Export the plan alone; `bound` says how much is read.",
    "plan_truncated": "Export or send it again: its end is missing.",
    "plan_wrong_kind": "Export the RT Plan or RT Ion Plan, not what belongs to it.",
    "picture_missing": "Ask again once the session runs and a frame has come.",
    "precondition_failed": "Read it again, look at what changed, and send the new ETag; `bound` is the present one.",
    "qa_active": "Wait until the QA run has ended, or cancel it.",
    "qa_overdue": "Do the daily QA.",
    "qa_state": "Read the run: its status says what it can still do.",
    "recording_unreadable": "Take another recording; `detail` says what is wrong with this one.",
    "request_timeout": "Send the request in one go.",
    "samples_removed": "The site removed them by age. Backups may have them.",
    "service_stopping": "Wait until the service is there again.",
    "session_active": "Stop the session that is named first.",
    "session_state": "Read the session: its status says what it can still do.",
    "source_lost": "Look at the camera and its cable.",
    "source_unusable": "Read `detail`; create another session with a source that works.",
    "storage_low": "Have the administrator make room; `bound` says how much.",
    "storage_unavailable": "It may have been done all the same: look, then try again; safe with an `Idempotency-Key`.",
    "storage_unwritable": "Have the administrator look at the disk.",
    "stream_full": "Come back after `Retry-After`, or have the site allow more.",
    "training_refused": "Read `detail`, let the patient breathe quietly, and learn again.",
    "url_too_long": "Shorten the path and the query.",
    "wrong_password": "Give the present password.",
}
USUAL = {
    "bad_request": "The body cannot be read at all.",
    "body_too_large": "The body is larger than the site takes.",
    "request_timeout": "The request, or its body, did not come within the time that the site gives.",
    "url_too_long": "Path and query are longer than the site takes.",
    "headers_too_large": "The headers are longer, or more, than the site takes.",
    "not_implemented": "The body comes in a Transfer-Encoding that is not known here.",
    "method_not_allowed": "The path is there, and not by this method.",
    "host_refused": "The request names a host that is not served here.",
    "internal_error": "A bug, or something nobody thought of; nothing of the inside is told.",
    STORAGE_CODE: "The database does not answer, or is locked for longer than anybody waits.",
    "http_error": "The protocol was not kept.",
}
TITLES = {
    "bad_request": "It cannot be read",
    "body_too_large": "The body is too large",
    "request_timeout": "The request took too long",
    "url_too_long": "The URL is too long",
    "headers_too_large": "The headers are too large",
    "not_implemented": "The Transfer-Encoding is not known",
    "method_not_allowed": "Method Not Allowed",
    "host_refused": "This name is not served here",
    "internal_error": "Tidegate failed",
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

    @property
    def example(self) -> dict[str, object]:
        """Return a problem with this code."""
        told = {"type": f"{PROBLEM_TYPE}{self.code}", "title": self.title, "status": self.status}
        example: dict[str, object] = {**told, "detail": self.when, "code": self.code}
        if self.code == "invalid_value":
            broken = {"field": "window.lower_mm", "value": "-400.0", "bound": "at least -100"}
            example |= {"detail": "window.lower_mm: at least -100", **broken, "errors": [broken]}
        return example


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
