"""The spelling of patients, plans and fractions: the first one that was entered, by which all later ones are stored.

So equal text is what is compared everywhere. A plan's name belongs to its patient, a fraction's to its plan.
"""

from typing import NamedTuple

from sqlalchemy import Connection, select
from sqlalchemy.orm import Session

from service.core.identity import identity_key, identity_text
from service.storage.database.tables import IdentityRow

PATIENT, PLAN, FRACTION = "patient", "plan", "fraction"
SEPARATOR = "\x1f"


class Identity(NamedTuple):
    """A fraction of a plan of a patient, as it is stored and shown."""

    patient_reference: str
    plan_id: str
    fraction_id: str


def stored(db: Session, patient_reference: str, plan_id: str, fraction_id: str = "") -> Identity:
    """Return the stored spelling of each; what is not stored as it would be."""
    texts = (patient_reference, plan_id, fraction_id)
    found = [db.get(IdentityRow, key) for key in _keys(*texts)]
    return Identity(*(text if row is None else row.text for row, text in zip(found, texts, strict=True)))


def keep(db: Session, patient_reference: str, plan_id: str, fraction_id: str) -> Identity:
    """Return the stored spelling of each; one that is new is stored."""
    texts = (patient_reference, plan_id, fraction_id)
    for (kind, key), text in zip(_keys(*texts), texts, strict=True):
        if db.get(IdentityRow, (kind, key)) is None:
            db.add(IdentityRow(kind=kind, key=key, text=identity_text(text)))
            db.flush()
    return stored(db, *texts)


def _keys(*texts: str) -> list[tuple[str, str]]:
    """Return kind and key of a patient, of its plan, and of the plan's fraction."""
    keys = [identity_key(text) for text in texts]
    return [(kind, SEPARATOR.join(keys[: number + 1])) for number, kind in enumerate((PATIENT, PLAN, FRACTION))]


class Collision(NamedTuple):
    """A stored spelling that is like another one, and was not merged with it."""

    kind: str
    text: str
    like: str


def collisions(connection: Connection) -> list[Collision]:
    """Return the spellings of before they were compared that are like others."""
    table = IdentityRow.__table__
    query = select(table.c.kind, table.c.text, table.c.like).where(table.c.like.is_not(None))
    return [Collision(*row) for row in connection.execute(query.order_by(table.c.kind, table.c.text))]
