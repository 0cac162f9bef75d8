"""What others open of a session that is over: DICOM files, and its breathing curve for an export."""

import json
from typing import TYPE_CHECKING

from sqlalchemy import select

from service.core.errors import BoundError
from service.core.schemas.plans import RtPlan
from service.exchange.curve import COLUMNS, BreathingCurve, curve_of
from service.sessions.report.pages import report_pdf
from service.sessions.report.reports import ReportService, refuse_open
from service.storage.database import queries
from service.storage.database.engine import Database
from service.storage.database.tables import PlanRow, SessionRow
from service.storage.samples.service import SampleService
from service.storage.samples.store import SampleStore

if TYPE_CHECKING:
    from service.exchange.dicom import Subject


class SessionExports:
    """Makes the files; all of them need a session that is over, with its samples.

    Every method raises NotFoundError, SessionStateError or SamplesRemovedError as a report does.
    """

    def __init__(self, database: Database, store: SampleStore, reports: ReportService) -> None:
        self._database, self._store, self._reports = database, store, reports

    def curve(self, session_id: str) -> BreathingCurve:
        """Return the breathing curve."""
        with self._database.read() as db:
            row = queries.session_row(db, session_id)
            refuse_open(row)
            SampleService(self._database, self._store).refuse_removed(session_id, row.summary)
        return curve_of(session_id, self._store.batches(session_id, COLUMNS), self._store.head(session_id))

    def patient_reference(self, session_id: str) -> str:
        """Return the site's reference for the session's patient."""
        with self._database.read() as db:
            return queries.session_row(db, session_id).patient_reference

    def waveform(self, session_id: str, patient_id: str | None = None) -> bytes:
        """Return the curve as DICOM; with ``patient_id`` de-identified, under that identifier.

        Raises
        ------
        BoundError
            ``patient_id`` is none that DICOM takes.
        """
        from service.exchange.dicom import waveform

        curve = self.curve(session_id)
        subject = self._subject(session_id, curve)
        return waveform(subject if patient_id is None else subject.deidentified(patient_id), curve)

    def report(self, session_id: str) -> bytes:
        """Return the report as a DICOM document: it names the patient, and has no de-identified form."""
        from service.exchange.dicom import report_document

        stored = self._reports.of(session_id)
        return report_document(self._subject(session_id, self.curve(session_id)), report_pdf(stored))

    def _subject(self, session_id: str, curve: BreathingCurve) -> "Subject":
        from service.exchange.dicom import Subject  # with pydicom, which nothing else of a running service needs

        report = self._reports.of(session_id).report
        session, head = report.session, report.head
        with self._database.read() as db:
            document = db.scalar(
                select(PlanRow.document)
                .join(SessionRow, SessionRow.rt_plan_id == PlanRow.id)
                .where(SessionRow.id == session_id)
            )
        plan = None if document is None else RtPlan.model_validate(json.loads(document))
        number = "" if session.fraction_number is None else f" {session.fraction_number}"
        return Subject(
            patient_id=_identifier(session.patient_reference),
            session_id=session_id,
            plan_label=head.plan_label or session.plan_id,
            plan_uid=head.plan_uid,
            fraction=f"{session.fraction_id}{number}",
            room=head.room,
            machine=head.machine,
            camera=head.camera,
            begun_at=curve.begun_at,
            character_set=() if plan is None else tuple(plan.character_set),
        )


def _identifier(reference: str) -> str:
    """Return the patient's reference; refuse one that no Patient ID can be, rather than change it."""
    if len(reference) > 64 or "\\" in reference:
        bound = "at most 64 characters without a backslash, for DICOM"
        msg = f"patient_reference must have {bound}"
        raise BoundError(msg, field="patient_reference", value=reference[:64], bound=bound)
    return reference
