"""What in the audit is about a patient, so that it can be left out where nobody asked for it."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.audit.chain import Link
from service.db.models import SessionRow

FIELDS = frozenset({"patient_reference", "plan_id", "fraction_id", "fraction_number"})
"""What a session says about its patient."""
BEFORE_A_SESSION = frozenset({"session.create", "plan.import"})
OF_SESSIONS = ("session.", "model.")
ABOUT = ("patient_reference", "plan_id", "fraction_id")


@dataclass(frozen=True, slots=True, kw_only=True)
class Patient:
    """Who a session was about, as the site calls them."""

    reference: str
    words: frozenset[str]


def patients_of(db: Session, session_ids: Iterable[str | None]) -> dict[str, Patient]:
    """Find whom sessions are about."""
    asked = {one for one in session_ids if one is not None}
    columns = (SessionRow.id, SessionRow.patient_reference, SessionRow.plan_id, SessionRow.fraction_id)
    rows = db.execute(select(*columns).where(SessionRow.id.in_(asked))).all() if asked else []
    return {row[0]: Patient(reference=row[1], words=frozenset(row[1:])) for row in rows}


def is_about_patient(link: Link, patient: Patient | None) -> bool:
    """Whether a row's detail tells a patient's reference, plan or fraction: by the field's name, or by what it says."""
    if link.action in BEFORE_A_SESSION or (link.session_id is None and link.action.startswith(OF_SESSIONS)):
        return True  # what was asked for, or why it was refused, names the patient in words of any kind
    detail = parsed(link.detail)
    if detail is None or FIELDS & {str(name) for name in _names(detail)}:
        return True
    if str(detail.get("field", "")).rpartition(".")[2] in FIELDS:
        return True
    words = patient.words if patient is not None else frozenset()
    return any(word in words or any(one in word for one in words if len(one) > 2) for word in _words(detail))


def parsed(text: str) -> Mapping[str, object] | None:
    """Read a row's detail; None where somebody made it something else."""
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
