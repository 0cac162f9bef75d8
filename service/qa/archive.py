"""Read stored QA runs, trends and reports, and set the baseline."""

from datetime import UTC, datetime

from sqlalchemy.orm import Session

from engine.qa import BASELINE_BOUNDS, check_of
from service.core.conditional import ANYTHING, Precondition
from service.core.errors import BoundError, QaActiveError, QaStateError
from service.core.list_filters import ALL_RUNS, QaRunFilter
from service.core.settings.settings import Settings
from service.qa import queries, schemas, views
from service.qa.arming_requirement import refusal
from service.qa.jobs import CurrentRun
from service.qa.latency.requirement import latency_list
from service.qa.latency.schemas import CameraLatencyList
from service.storage.audit.log import AuditLog
from service.storage.database.engine import Database

KINDS: tuple[schemas.Kind, ...] = ("daily", "monthly", "annual")
TREND_RUNS = 30


class QaArchive:
    """Reads stored runs and sets baselines; ``current_run`` supplies the progress of a run."""

    def __init__(self, database: Database, log: AuditLog, settings: Settings, current_run: CurrentRun) -> None:
        self._database = database
        self._log = log
        self._settings = settings
        self._current_run = current_run

    def page(self, cursor: str | None, limit: int, filters: QaRunFilter = ALL_RUNS) -> schemas.QaRunPage:
        """List runs, newest first."""
        with self._database.read() as db:
            rows, next_cursor = queries.run_page(db, cursor, limit, filters)
            return schemas.QaRunPage(
                items=[self._current_run.run_answer(db, row) for row in rows], next_cursor=next_cursor
            )

    def detail(self, run_id: str) -> schemas.QaRunDetail:
        """Return a run with its checks; raise NotFoundError if there is none."""
        with self._database.read() as db:
            return self._detail(db, run_id)

    def report_pdf(self, run_id: str) -> bytes:
        """Return the report of a finished run; raise QaStateError for any other."""
        with self._database.read() as db:
            detail = self._detail(db, run_id)
            if detail.status != "finished":
                msg = f"the QA run is {detail.status}: only a finished run has a report"
                raise QaStateError(msg, field="status", value=detail.status, bound="finished")
            row = queries.run_row(db, run_id)
            trends = [views.trend_answer(db, one.code, TREND_RUNS, before=row) for one in detail.results]
        # Imported on demand: most services print none.
        from service.qa.report.report import report_pdf

        return report_pdf(detail, trends)

    def trend(self, check: str, limit: int) -> schemas.QaTrend:
        """Return the values of a check in the newest runs; raise InvalidValueError for an unknown check."""
        with self._database.read() as db:
            return views.trend_answer(db, check, limit)

    def checks(self) -> schemas.QaCheckList:
        """List the checks with this site's bounds."""
        return views.check_list(self._settings)

    def status(self) -> schemas.QaStatus:
        """Return the newest run of each kind, and whether the site's QA requirement permits arming."""
        with self._database.read() as db:
            newest = {kind: queries.newest_run(db, [kind]) for kind in KINDS}
            answers = {
                kind: None if row is None else self._current_run.run_answer(db, row) for kind, row in newest.items()
            }
            reason = refusal(db, self._settings, datetime.now(UTC))
        return schemas.QaStatus(
            newest=answers,
            required_daily_h=self._settings.qa_required_daily_h,
            is_arming_allowed=reason is None,
            refusal=reason,
        )

    def latencies(self) -> CameraLatencyList:
        """Return the newest measured latency of each camera and mode."""
        with self._database.read() as db:
            return latency_list(db, self._settings)

    def baseline(self) -> schemas.QaBaselineHistory:
        """Return the current baseline and the earlier ones, newest first."""
        with self._database.read() as db:
            return views.baseline_history(queries.baseline_rows(db))

    def fix_baseline(
        self, request: schemas.QaBaselineRequest, precondition: Precondition = ANYTHING
    ) -> schemas.QaBaseline:
        """Set a new baseline from given values or from a run's measurement; raise QaActiveError during a run."""
        with self._log.refusals(actor=request.operator, action=queries.BASELINE), self._database.write() as db:
            if self._current_run.run_id is not None:
                msg = "a QA run is in progress: set the baseline after its end"
                raise QaActiveError(msg, field="run_id", value=self._current_run.run_id, bound="no QA run under way")
            newest = queries.newest_baseline(db)
            precondition.require(views.baseline_etag(0 if newest is None else newest.number))
            row = queries.fix_baseline(db, _expected(db, request), operator=request.operator, reason=request.reason)
            return views.baseline_answer(row)

    def _detail(self, db: Session, run_id: str) -> schemas.QaRunDetail:
        return self._current_run.run_detail(db, queries.run_row(db, run_id))


def close_interrupted(database: Database) -> None:
    """Store the outcome ``interrupted`` for runs of a killed program; needs the exclusive lock of the data folder."""
    with database.write() as db:
        for row in queries.unended_runs(db):
            queries.end(db, row.id, queries.QaOutcome(status="interrupted", detail=views.INTERRUPTED))


def _expected(db: Session, request: schemas.QaBaselineRequest) -> dict[str, float]:
    if request.expected is not None:
        return {name: float(value) for name, value in request.expected.model_dump(exclude_none=True).items()}
    assert request.run_id is not None, "a request has expected or run_id"
    return measured_by(db, request.run_id)


def measured_by(db: Session, run_id: str) -> dict[str, float]:
    """Return the baseline values that a finished run measured; raise if it cannot be used as a baseline."""
    row, outcome = queries.run_row(db, run_id), queries.outcome_row(db, run_id)
    status = "running" if outcome is None else outcome.status
    if status != "finished":
        msg = f"the QA run is {status}: only a finished run can become a baseline"
        raise QaStateError(msg, field="run_id", value=run_id, bound="a finished run")
    if row.is_simulated:
        bound = "a run that is not simulated"
        msg = f"run_id must be {bound}"
        raise BoundError(msg, field="run_id", value=run_id, bound=bound)
    found = {one.code: one.value for one in queries.result_rows(db, run_id) if one.code in BASELINE_BOUNDS}
    missing = [check_of(code).title for code in BASELINE_BOUNDS if found.get(code) is None]
    if missing:
        bound = "a run that measured all baseline values"
        msg = f"run_id must be {bound}: {', '.join(missing)} could not be measured"
        raise BoundError(msg, field="run_id", value=run_id, bound=bound)
    return {code: value for code, value in found.items() if value is not None}
