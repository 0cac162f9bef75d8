"""Export of the audit as JSON lines, written in pieces at constant memory.

An export ends with a line that states its number of rows and its filters, so that truncation is detected. Each row has
its hash, so that the file can be verified without the database.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import Select, select
from sqlalchemy.orm import Session

from service.storage.audit.chain import COLUMNS, Link, canonical_json
from service.storage.audit.verification import Breakage, Verification, head_sequence, is_sealed
from service.storage.database.base import utc_text
from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow, SessionRow

FIELDS = frozenset({"patient_reference", "plan_id", "fraction_id", "fraction_number"})
"""Fields of a session that identify its patient."""
BEFORE_A_SESSION = frozenset({"session.create", "plan.import"})
OF_SESSIONS = ("session.", "model.")
ABOUT = ("patient_reference", "plan_id", "fraction_id")
PIECE_ROWS = 500
END = "tidegate.audit/1"
MAX_LINE_CHARACTERS = 16_777_216
MEDIA = "application/x-ndjson"


# Detection of patient data in audit rows, which exports omit unless it is requested.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportRequest:
    """Filters of an export: ``since`` inclusive, ``until`` exclusive, None does not filter.

    ``with_patients`` false leaves out the details that name a patient.
    """

    since: datetime | None = None
    until: datetime | None = None
    session_id: str | None = None
    with_patients: bool = True

    def audit_detail(self) -> dict[str, object]:
        """Return the detail of the export's audit row."""
        return {
            "since": None if self.since is None else utc_text(self.since),
            "until": None if self.until is None else utc_text(self.until),
            "session_id": self.session_id,
            "with_patients": self.with_patients,
        }


def write_export(database: Database, request: ExportRequest) -> Iterator[str]:
    """Yield the rows that existed at the first call, as text in pieces."""
    with database.read() as db:
        up_to = head_sequence(db)
    after, rows, last = None, 0, None
    while True:
        with database.read() as db:  # one session per piece: a slow client must not block checkpoints
            links = [Link._make(row) for row in db.execute(_query(request, after, up_to))]
            text = "".join(json_lines(db, links, with_patients=request.with_patients))
        if not links:
            break
        after, rows, last = links[-1].sequence, rows + len(links), links[-1]
        yield text
    end = {"rows": rows, "last_hash": None if last is None else last.hash, **request.audit_detail()}
    yield f"{canonical_json({'schema': END, 'end': end})}\n"


def json_lines(db: Session, links: list[Link], *, with_patients: bool) -> Iterator[str]:
    """Yield a line a row; without patients, a detail that names one is left out; the row keeps its place and hash."""
    patients = {} if with_patients else patients_of(db, (link.session_id for link in links))
    for link in links:
        patient = None if link.session_id is None else patients.get(link.session_id)
        fields = _fields(link) if with_patients or not is_about_patient(link, patient) else _without_detail(link)
        yield f"{canonical_json(fields)}\n"


def verify_export(lines: Iterable[str]) -> Verification:
    """Verify an export without the database: each row's hash, and the chain between consecutive rows."""
    found = _ExportCheck()
    for line in lines:
        if not found.take(line):
            break
    return found.end()


class _ExportCheck:
    def __init__(self) -> None:
        self.before: Link | None = None
        self.rows = 0
        self.without_detail = 0
        self.gaps = 0
        self.ended: object = None
        self.broken: tuple[int | None, Breakage, str] | None = None

    def take(self, line: str) -> bool:
        """Check one line; return False if the file is broken."""
        fields = parsed(line)
        if fields is not None and fields.get("schema") == END:
            self.ended = fields.get("end")
            return True
        row = None if fields is None else _row(fields)
        if row is None:
            self.broken = (None, Breakage.CHANGED, f"line {self.rows + 1} is no row of an audit log")
            return False
        link, has_detail = row
        return self._check(link, has_detail=has_detail)

    def end(self) -> Verification:
        """Return the result."""
        if self.broken is None:
            self._check_end()
        notes = [f"{self.gaps} places at which rows were left out"] * bool(self.gaps)
        notes += [f"{self.without_detail} rows without their detail: only their place in the chain was checked"] * bool(
            self.without_detail
        )
        head = "" if self.before is None else self.before.hash
        detail = "every row fits its seal, and the row before it where that is in the file"
        sequence, breakage, detail = self.broken or (None, None, detail)
        return Verification(
            rows=self.rows,
            head_hash=head,
            first_broken_sequence=sequence,
            breakage=breakage,
            detail=detail,
            notes=tuple(notes),
        )

    def _check(self, link: Link, *, has_detail: bool) -> bool:
        before = self.before
        if self.ended is not None:
            self.broken = (link.sequence, Breakage.INSERTED, f"row {link.sequence} stands after the end of the export")
        elif has_detail and not is_sealed(link):
            self.broken = (link.sequence, Breakage.CHANGED, f"row {link.sequence} was changed after it was written")
        elif before is not None and link.sequence <= before.sequence:
            text = f"row {link.sequence} stands after row {before.sequence}"
            self.broken = (link.sequence, Breakage.REORDERED, text)
        elif before is not None and link.sequence == before.sequence + 1 and link.previous_hash != before.hash:
            text = f"row {link.sequence} does not follow from the row before it"
            self.broken = (link.sequence, Breakage.RESEALED, text)
        if self.broken is not None:
            return False
        self.gaps += before is not None and link.sequence != before.sequence + 1
        self.without_detail += not has_detail
        self.before, self.rows = link, self.rows + 1
        return True

    def _check_end(self) -> None:
        end = self.ended if isinstance(self.ended, dict) else None
        if end is None:
            self.broken = (
                None,
                Breakage.CUT_OFF,
                f"the file ends after {self.rows} rows without saying so: it was cut off",
            )
            return
        fields = (end.get("rows"), end.get("last_hash"))
        if fields != (self.rows, None if self.before is None else self.before.hash):
            text = f"the file's end gives {fields[0]} rows; it has {self.rows}, or another last row"
            self.broken = (None, Breakage.MISSING, text)
        is_whole = all(end.get(name) is None for name in ("since", "until", "session_id"))
        if self.broken is None and is_whole and self.gaps:
            self.broken = (None, Breakage.MISSING, f"rows are missing at {self.gaps} places of a whole export")


def _query(request: ExportRequest, after: int | None, up_to: int) -> "Select[tuple[object, ...]]":
    query = select(*COLUMNS).where(AuditRow.sequence <= up_to).order_by(AuditRow.sequence).limit(PIECE_ROWS)
    if after is not None:
        query = query.where(AuditRow.sequence > after)
    if request.session_id is not None:
        query = query.where(AuditRow.session_id == request.session_id)
    if request.since is not None:
        query = query.where(AuditRow.at >= utc_text(request.since))
    if request.until is not None:
        query = query.where(AuditRow.at < utc_text(request.until))
    return query


def _fields(link: Link) -> dict[str, object]:
    """Return a row with its detail as an object, or as text if the object would not give the hashed text."""
    detail = parsed(link.detail)
    fields: dict[str, object] = {**link._asdict(), "detail": detail}
    if detail is None or canonical_json(detail) != link.detail:
        fields |= {"detail": None, "detail_text": link.detail}
    return fields


def _without_detail(link: Link) -> dict[str, object]:
    fields = link._asdict()
    del fields["detail"]
    return fields


def _row(fields: object) -> tuple[Link, bool] | None:
    if not isinstance(fields, dict):
        return None
    has_detail = "detail" in fields
    try:
        detail = fields["detail_text"] if fields.get("detail", "") is None else canonical_json(fields.get("detail"))
        link = Link(**{**{name: fields[name] for name in Link._fields if name != "detail"}, "detail": detail})
    except (KeyError, TypeError, ValueError):
        return None
    is_row = isinstance(link.sequence, int) and isinstance(link.hash, str)
    return (link, has_detail) if is_row else None
