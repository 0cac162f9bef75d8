"""Detection of patient data in audit rows, which exports omit unless it is requested."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.storage.audit.chain import Link
from service.storage.database.tables import SessionRow

FIELDS = frozenset({"patient_reference", "plan_id", "fraction_id", "fraction_number"})
"""Fields of a session that identify its patient."""
BEFORE_A_SESSION = frozenset({"session.create", "plan.import"})
OF_SESSIONS = ("session.", "model.")
ABOUT = ("patient_reference", "plan_id", "fraction_id")


@dataclass(frozen=True, slots=True, kw_only=True)
class Patient:
    """The patient of a session: the site's reference, and the texts that identify them."""

    reference: str
    words: frozenset[str]


def patients_of(db: Session, session_ids: Iterable[str | None]) -> dict[str, Patient]:
    """Return the patients of sessions by session id; unknown ids are absent."""
    asked = {one for one in session_ids if one is not None}
    columns = (SessionRow.id, SessionRow.patient_reference, SessionRow.plan_id, SessionRow.fraction_id)
    rows = db.execute(select(*columns).where(SessionRow.id.in_(asked))).all() if asked else []
    return {row[0]: Patient(reference=row[1], words=frozenset(row[1:])) for row in rows}


def is_about_patient(link: Link, patient: Patient | None) -> bool:
    """Whether a row's detail contains a patient's reference, plan or fraction, as a field or within a text."""
    if link.action in BEFORE_A_SESSION or (link.session_id is None and link.action.startswith(OF_SESSIONS)):
        return True  # their request or refusal may name the patient in free text
    detail = parsed(link.detail)
    if detail is None or FIELDS & {str(name) for name in _names(detail)}:
        return True
    if str(detail.get("field", "")).rpartition(".")[2] in FIELDS:
        return True
    words = patient.words if patient is not None else frozenset()
    return any(word in words or any(one in word for one in words if len(one) > 2) for word in _words(detail))


def parsed(text: str) -> Mapping[str, object] | None:
    """Parse a row's detail; None if it is not a JSON object (a tampered row)."""
    try:
        found = json.loads(text)
    except (ValueError, TypeError):
        return None
    return found if isinstance(found, dict) else None


def _names(value: object) -> Iterable[object]:
    if isinstance(value, dict):
        yield from value
        for inner in value.values():
            yield from _names(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _names(inner)


def _words(value: object) -> Iterable[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for inner in value.values():
            yield from _words(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _words(inner)
