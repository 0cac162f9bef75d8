"""Sample files in the audit: each file's hash, and which files were removed."""

import json
from dataclasses import dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.storage.audit import AuditRow

CLOSED, SETTLED, REMOVED = "session.close", "samples.settled", "samples.removed"


@dataclass(frozen=True, slots=True, kw_only=True)
class Registered:
    """A session's newest sample entry in the audit: rows, hash of the Parquet file, whether it was removed."""

    rows: int = 0
    sha256: str | None = None
    is_removed: bool = False


def registered(db: Session, session_id: str) -> Registered:
    """Read a session's newest sample entry; None without one."""
    query = select(AuditRow.action, AuditRow.detail).where(
        AuditRow.session_id == session_id, AuditRow.action.in_((CLOSED, SETTLED, REMOVED))
    )
    found = Registered()
    for action, text in db.execute(query.order_by(AuditRow.sequence)):
        detail = json.loads(text)
        said = detail.get("samples", {}) if action == CLOSED else detail
        if action == REMOVED:
            found = Registered(rows=found.rows, sha256=found.sha256, is_removed=True)
        elif said.get("parquet_sha256") is not None:
            found = Registered(rows=int(said["rows"]), sha256=str(said["parquet_sha256"]))
    return found
