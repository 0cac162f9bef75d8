"""The audit for whoever reads it: pages, the chain walked without holding the service up, exports written down."""

import threading
from collections.abc import Iterator
from dataclasses import dataclass

from service.audit import Event
from service.audit.anchors import AnchorFile, AnchorReport
from service.audit.check import lost_lines, reader, row_at, with_report
from service.audit.export import ExportRequest, write_export
from service.audit.walk import Verification, Walk, head_sequence, pieces
from service.audit_log import AuditLog
from service.audit_schemas import AuditPage, AuditVerification
from service.db.engine import Database
from service.errors import AuditBusyError, NotFoundError
from service.list_filters import ALL_ROWS, AuditFilter
from service.problem_schemas import Problem

PAUSE_S = 0.01
"""Between two pieces of a walk: whoever else wants the interpreter, or the database, gets it."""
EXPORT = "audit.export"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Looked:
    """What the file of heads said when it was this long."""

    size_bytes: int
    report: AnchorReport


class AuditDesk:
    """Answers whoever reads the audit."""

    def __init__(self, database: Database, log: AuditLog, file: AnchorFile, *, site: str = "") -> None:
        self._database = database
        self._log = log
        self._file = file
        self._site = site
        self._walking = threading.Lock()
        self._pause = threading.Event()
        self._looked: _Looked | None = None

    def page(self, cursor: str | None, limit: int, session_id: str | None, wanted: AuditFilter = ALL_ROWS) -> AuditPage:
        """List rows, newest first."""
        return self._log.page(cursor, limit, session_id, wanted)

    def refused(self, *, actor: str, action: str, session_id: str | None, problem: Problem) -> None:
        """Write down a call that was refused before anyone acted on it."""
        self._log.refused(actor=actor, action=action, session_id=session_id, problem=problem)

    def exported(self, *, actor: str, action: str, session_id: str | None, detail: dict[str, object]) -> None:
        """Write down that something leaves the house; before it does."""
        self._log.write(Event(actor=actor, action=action, session_id=session_id, detail=detail))

    def export(self, request: ExportRequest, actor: str) -> Iterator[str]:
        """Write the export down, then the rows that were there before, piece by piece."""
        if request.session_id is not None:
            self._refuse_unknown(request.session_id)
        self._log.write(Event(actor=actor, action=EXPORT, session_id=request.session_id, detail=request.told()))
        return write_export(self._database, request, site=self._site)

    def verify(self, after: int, limit: int) -> AuditVerification:
        """Walk a bounded part of the chain, in pieces with pauses; one walk at a time."""
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
        found = walk.end() if is_complete else walk.so_far()
        return _told(with_report(found, report, trouble), walk.last_sequence, is_complete=is_complete)

    def _report(self) -> AnchorReport:
        """Read the file of heads, where it has grown since the last time."""
        reached = self._file.reached()
        size_bytes = 0 if reached is None else reached.size_bytes
        if self._looked is None or self._looked.size_bytes != size_bytes:
            self._looked = _Looked(size_bytes=size_bytes, report=self._file.report())
        return self._looked.report

    def _refuse_unknown(self, session_id: str) -> None:
        page = self._log.page(None, 1, session_id)
        if not page.items:
            msg = "the audit knows no such session"
            raise NotFoundError(msg, field="session_id", value=session_id)


def _told(found: Verification, checked_to: int, *, is_complete: bool) -> AuditVerification:
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
