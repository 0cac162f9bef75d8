"""What is kept of QA, as it is asked for; and the baseline, which a named person fixes."""

from datetime import UTC, datetime

from sqlalchemy.orm import Session

from engine.qa.bounds import BASELINE_BOUNDS
from engine.qa.checks import check_of
from service.audit_log import AuditLog
from service.conditional import ANYTHING, Precondition
from service.db.engine import Database
from service.errors import BoundError, QaActiveError, QaStateError
from service.list_filters import ALL_RUNS, QaRunFilter
from service.qa import records, schemas, views
from service.qa.requirement import refusal
from service.qa.under_way import UnderWay
from service.settings import Settings

KINDS: tuple[schemas.Kind, ...] = ("daily", "monthly", "annual")
TREND_RUNS = 30


class QaBook:
    """The book of QA; ``under_way`` tells which run goes on now."""

    def __init__(self, database: Database, log: AuditLog, settings: Settings, under_way: UnderWay) -> None:
        self._database = database
        self._log = log
        self._settings = settings
        self._under_way = under_way

    def page(self, cursor: str | None, limit: int, wanted: QaRunFilter = ALL_RUNS) -> schemas.QaRunPage:
        """List runs, newest first."""
        with self._database.read() as db:
            rows, next_cursor = records.run_page(db, cursor, limit, wanted)
            return schemas.QaRunPage(
                items=[self._under_way.run_answer(db, row) for row in rows], next_cursor=next_cursor
            )

    def detail(self, run_id: str) -> schemas.QaRunDetail:
        """Read one, as it stands now."""
        with self._database.read() as db:
            return self._detail(db, run_id)

    def report_pdf(self, run_id: str) -> bytes:
        """Print a run that has finished; raise QaStateError for any other."""
        with self._database.read() as db:
            detail = self._detail(db, run_id)
            if detail.status != "finished":
                msg = f"the QA run is {detail.status}: only a finished one is printed"
                raise QaStateError(msg, field="status", value=detail.status, bound="finished")
            row = records.run_row(db, run_id)
            trends = [views.trend_answer(db, one.code, TREND_RUNS, before=row) for one in detail.results]
        # Imported when somebody prints: what draws is a fifth of the time that a service takes to start.
        from service.qa.report import report_pdf

        return report_pdf(detail, trends)

    def trend(self, check: str, limit: int) -> schemas.QaTrend:
        """Tell a check over the newest runs; raise InvalidValueError where there is no such check."""
        with self._database.read() as db:
            return views.trend_answer(db, check, limit)

    def checks(self) -> schemas.QaCheckList:
        """List what is checked, with this site's bounds."""
        return views.check_list(self._settings)

    def status(self) -> schemas.QaStatus:
        """Tell the newest runs that count, and whether the site's QA lets anybody arm."""
        with self._database.read() as db:
            newest = {kind: records.newest_run(db, [kind]) for kind in KINDS}
            told = {kind: None if row is None else self._under_way.run_answer(db, row) for kind, row in newest.items()}
            reason = refusal(db, self._settings, datetime.now(UTC))
        return schemas.QaStatus(
            newest=told,
            required_daily_h=self._settings.qa_required_daily_h,
            is_arming_allowed=reason is None,
            refusal=reason,
        )

    def baseline(self) -> schemas.QaBaselineHistory:
        """Tell the baseline that holds, and those before it, newest first."""
        with self._database.read() as db:
            return views.baseline_history(records.baseline_rows(db))

    def fix_baseline(self, request: schemas.QaBaselineRequest, wanted: Precondition = ANYTHING) -> schemas.QaBaseline:
        """Fix another, as a named person says or as a run measured; refused while a run goes on."""
        with self._log.refusals(actor=request.operator, action=records.BASELINE), self._database.write() as db:
            if self._under_way.run_id is not None:
                msg = "a QA run is under way: it is judged by the baseline it began with"
                raise QaActiveError(msg, field="run_id", value=self._under_way.run_id, bound="no QA run under way")
            newest = records.newest_baseline(db)
            wanted.require(views.baseline_etag(0 if newest is None else newest.number))
            row = records.fix_baseline(db, _expected(db, request), operator=request.operator, reason=request.reason)
            return views.baseline_answer(row)

    def _detail(self, db: Session, run_id: str) -> schemas.QaRunDetail:
        return self._under_way.run_detail(db, records.run_row(db, run_id))


def close_interrupted(database: Database) -> None:
    """Write down the end of the runs that a killed program left without one; called by whoever has the folder alone."""
    with database.write() as db:
        for row in records.unended_runs(db):
            records.end(db, row.id, records.QaOutcome(status="interrupted", detail=views.INTERRUPTED))


def _expected(db: Session, request: schemas.QaBaselineRequest) -> dict[str, float]:
    if request.expected is not None:
        return {name: float(value) for name, value in request.expected.model_dump(exclude_none=True).items()}
    assert request.run_id is not None, "a request has either"
    return measured_by(db, request.run_id)


def measured_by(db: Session, run_id: str) -> dict[str, float]:
    """Return what a finished run measured of what a baseline is fixed for; raise where it is no basis for one."""
    row, outcome = records.run_row(db, run_id), records.outcome_row(db, run_id)
    status = "running" if outcome is None else outcome.status
    if status != "finished":
        msg = f"the QA run is {status}: only a finished one says what to expect"
        raise QaStateError(msg, field="run_id", value=run_id, bound="a finished run")
    if row.is_simulated:
        bound = "a run that is not simulated"
        msg = f"run_id must be {bound}"
        raise BoundError(msg, field="run_id", value=run_id, bound=bound)
    found = {one.code: one.value for one in records.result_rows(db, run_id) if one.code in BASELINE_BOUNDS}
    missing = [check_of(code).title for code in BASELINE_BOUNDS if found.get(code) is None]
    if missing:
        bound = "a run that measured what a baseline is fixed for"
        msg = f"run_id must be {bound}: {', '.join(missing)} could not be measured"
        raise BoundError(msg, field="run_id", value=run_id, bound=bound)
    return {code: value for code, value in found.items() if value is not None}
