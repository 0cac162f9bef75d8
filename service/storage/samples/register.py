"""Sample files in the audit: each file's hash, and which files were removed."""

import json
import logging
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
from sqlalchemy import select
from sqlalchemy.orm import Session

from engine.core.files import file_sha256
from service.storage import audit
from service.storage.audit import SYSTEM, AuditRow, Event
from service.storage.database.engine import Database
from service.storage.samples.parquet import parquet_head
from service.storage.samples.store import SampleStore

logger = logging.getLogger(__name__)

CLOSED, SETTLED, ADOPTED, REMOVED = "session.close", "samples.settled", "samples.adopted", "samples.removed"


@dataclass(frozen=True, slots=True, kw_only=True)
class Registered:
    """A session's newest sample entry in the audit: rows, hash of the Parquet file, whether it was removed."""

    rows: int = 0
    sha256: str | None = None
    is_removed: bool = False


def registered(db: Session, session_id: str) -> Registered:
    """Read a session's newest sample entry; None without one."""
    query = select(AuditRow.action, AuditRow.detail).where(
        AuditRow.session_id == session_id, AuditRow.action.in_((CLOSED, SETTLED, ADOPTED, REMOVED))
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


def adopt(database: Database, store: SampleStore) -> None:
    """Write the hash of files into the audit that it does not know: those that migration 0008 has made."""
    for session_id in store.stored():
        with database.read() as db:
            if registered(db, session_id).sha256 is not None:
                continue
        path = store.parquet_path(session_id)
        try:
            detail = _detail(path)
        except (pa.ArrowException, ValueError, KeyError):
            logger.warning("%s is no sample file, and the audit does not know it", path.name)
            continue
        except OSError as error:  # the others are no worse for it, and the next start tries again
            logger.warning("%s cannot be read, and the audit does not know it: %s", path.name, error.strerror)
            continue
        with database.write() as db:
            audit.append(db, Event(actor=SYSTEM, action=ADOPTED, session_id=session_id, detail=detail))


def _detail(path: Path) -> dict[str, object]:
    return {
        "rows": parquet_head(path)[1],
        "bytes": path.stat().st_size,
        "parquet_sha256": file_sha256(path),
        "detail": "moved out of the database by an upgrade",
    }
