"""Reading of the audit over HTTP: pages, verification in small pieces, and audited exports."""

import threading
from collections.abc import Iterator
from dataclasses import dataclass

from service.core.errors import AuditBusyError, NotFoundError
from service.core.list_filters import ALL_ROWS, AuditFilter
from service.core.schemas.base import Problem
from service.storage.audit import Event
from service.storage.audit.anchors import AnchorFile, AnchorReport
from service.storage.audit.check import lost_lines, reader, row_at, with_report
from service.storage.audit.export import ExportRequest, write_export
from service.storage.audit.log import AuditLog, AuditPage, AuditVerification
from service.storage.audit.verification import Verification, Walk, head_sequence, pieces
from service.storage.database.engine import Database

PAUSE_S = 0.01
"""Pause between two pieces of a verification [s], to release the interpreter and the database."""
EXPORT = "audit.export"


@dataclass(frozen=True, slots=True, kw_only=True)
class _CachedReport:
    """The anchor file's report, valid while the file has this size."""

    size_bytes: int
    report: AnchorReport


class AuditService:
    """Serves audit requests; called from request threads, all methods may block on the database."""

    def __init__(self, database: Database, log: AuditLog, file: AnchorFile) -> None:
        self._database = database
        self._log = log
        self._file = file
        self._walking = threading.Lock()
        self._pause = threading.Event()
        self._cached: _CachedReport | None = None

    def page(self, cursor: str | None, limit: int, session_id: str | None, wanted: AuditFilter = ALL_ROWS) -> AuditPage:
        """Return one page of rows, newest first, and the cursor of the next."""
        return self._log.page(cursor, limit, session_id, wanted)

    def refused(self, *, actor: str, action: str, session_id: str | None, problem: Problem) -> None:
        """Audit a call that was refused before it was executed."""
        self._log.refused(actor=actor, action=action, session_id=session_id, problem=problem)

    def exported(self, *, actor: str, action: str, session_id: str | None, detail: dict[str, object]) -> None:
        """Audit an export of data; call it before the data is sent."""
        self._log.write(Event(actor=actor, action=action, session_id=session_id, detail=detail))

    def export(self, request: ExportRequest, actor: str) -> Iterator[str]:
        """Audit the export, then yield the earlier rows in pieces; raise NotFoundError for an unknown session."""
        if request.session_id is not None:
            self._refuse_unknown(request.session_id)
        self._log.write(Event(actor=actor, action=EXPORT, session_id=request.session_id, detail=request.audit_detail()))
        return write_export(self._database, request)

    def verify(self, after: int, limit: int) -> AuditVerification:
        """Verify at most ``limit`` rows after ``after``; raise AuditBusyError while another verification runs."""
        if not self._walking.acquire(blocking=False):
            msg = "the audit is being verified for somebody else: one walk at a time"
            raise AuditBusyError(msg)
        try:
            return self._walk(after, limit)
        finally:
            self._walking.release()

    def _walk(self, after: int, limit: int) -> AuditVerification:
        report = self._report()
        with self._database.read() as db:
            before = None if after == 0 else row_at(db, after)
            head, trouble = head_sequence(db), report.trouble or lost_lines(db, self._file, report)
        if after != 0 and before is None:
            msg = "there is no such row"
            raise NotFoundError(msg, field="after", value=after, bound=f"0 to {head}")
        walk = Walk(self._file.heads(report.counts_from_byte), after=before)
        up_to = min(head, after + limit)
        for links in pieces(reader(self._database), after=after or None, up_to=up_to):
            if not walk.take(links):
                break
            self._pause.wait(PAUSE_S)
        is_complete = up_to == head
        found = walk.end() if is_complete else walk.result()
        return _to_schema(with_report(found, report, trouble), walk.last_sequence, is_complete=is_complete)

    def _report(self) -> AnchorReport:
        """Return the anchor file's report; read the file only if its size has changed."""
        reached = self._file.reached()
        size_bytes = 0 if reached is None else reached.size_bytes
        if self._cached is None or self._cached.size_bytes != size_bytes:
            self._cached = _CachedReport(size_bytes=size_bytes, report=self._file.report())
        return self._cached.report

    def _refuse_unknown(self, session_id: str) -> None:
        page = self._log.page(None, 1, session_id)
        if not page.items:
            msg = "the audit has no such session"
            raise NotFoundError(msg, field="session_id", value=session_id)


def _to_schema(found: Verification, checked_to: int, *, is_complete: bool) -> AuditVerification:
    return AuditVerification(
        is_intact=found.is_intact,
        is_complete=is_complete or not found.is_intact,
        rows=found.rows,
        checked_to=checked_to,
        head_hash=found.head_hash,
        first_broken_sequence=found.first_broken_sequence,
        breakage=found.breakage,
        detail=found.detail,
        notes=list(found.notes),
    )
