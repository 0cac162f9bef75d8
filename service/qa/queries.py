"""Database queries of QA: runs, outcomes, results, trends and baselines.

Each function runs in the given database session. Rows are never changed: the outcome of a run is a separate row.

The holds of the treatments since the last QA run: their time to the accelerator's beam off, as a figure of a run.

The times are the audit's rows `beam.off`, one for each permit of a session that ended with the beam on.
"""

import hashlib
import json
import math
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime

import numpy as np
from sqlalchemy import func, literal, select, tuple_
from sqlalchemy.orm import Session

from engine import __version__
from engine.qa import QaBaseline, QaBound, QaBounds, QaFigure, QaKind, QaReport, QaResult, check_of, checks_of, judge
from service.core.errors import NotFoundError
from service.core.list_filters import ALL_RUNS, QaRunFilter
from service.storage import audit
from service.storage.audit import Event
from service.storage.database import queries
from service.storage.database.base import UtcTime
from service.storage.database.tables import AuditRow, QaBaselineRow, QaOutcomeRow, QaResultRow, QaRunRow, SessionRow

TREATMENTS = "treatment_beam_off_ms"
START, END, BASELINE = "qa.start", "qa.end", "qa.baseline"


def treatment_figures(db: Session, *, is_simulated_beam: bool) -> list[QaFigure]:
    """Return the figure of the holds since the newest finished run; none where no beam-off was measured.

    Parameters
    ----------
    is_simulated_beam
        Which sessions count: those of a simulated line, or of a real one.
    """
    since = db.scalar(
        select(func.max(QaRunRow.created_at))
        .join(QaOutcomeRow, QaOutcomeRow.run_id == QaRunRow.id)
        .where(
            QaOutcomeRow.status == "finished",
            QaRunRow.is_simulated.is_(False),
            QaRunRow.kind != QaKind.LATENCY.value,  # which has no figure of the treatments
        )
    )
    query = (
        select(AuditRow.detail, AuditRow.session_id)
        .join(SessionRow, SessionRow.id == AuditRow.session_id)
        .where(AuditRow.action == queries.BEAM_OFF, SessionRow.is_simulated_beam.is_(is_simulated_beam))
    )
    if since is not None:
        query = query.where(SessionRow.started_at > since)
    rows = db.execute(query).all()
    if not rows:
        return []
    offs_ms = [float(json.loads(detail)["off_ms"]) for detail, _ in rows]
    count = f"{len(offs_ms)} holds in {len({session_id for _, session_id in rows})} sessions since the last run"
    detail = f"{count}: median {np.median(offs_ms):.1f} ms, slowest {max(offs_ms):.1f} ms"
    return [QaFigure(code=TREATMENTS, value=float(np.percentile(offs_ms, 95.0)), detail=detail)]


@dataclass(frozen=True, slots=True, kw_only=True)
class NewQaRun:
    """Record of a new run; ``plate_sha256`` is the hash of the plate's recording, None for a live camera."""

    kind: QaKind
    operator: str
    request: Mapping[str, object]
    site: str
    machine: str
    bounds: QaBounds
    is_simulated: bool
    is_simulated_beam: bool
    plate_sha256: str | None = None
    run_id: str = field(default_factory=lambda: uuid.uuid4().hex)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class QaOutcome:
    """End of a run: ``finished`` with a report, ``cancelled``, ``failed`` or ``interrupted`` without."""

    status: str
    detail: str = ""
    report: QaReport | None = None


def begin(db: Session, run: NewQaRun) -> QaRunRow:
    """Store and audit a new run; a simulated run gets no baseline, because the site's does not apply to it."""
    newest = None if run.is_simulated else newest_baseline(db)
    row = QaRunRow(
        id=run.run_id,
        kind=run.kind.value,
        operator=run.operator,
        site=run.site,
        machine=run.machine,
        request=audit.canonical_json(run.request),
        is_simulated=run.is_simulated,
        is_simulated_beam=run.is_simulated_beam,
        plate_sha256=run.plate_sha256,
        bounds=audit.canonical_json({check.code: asdict(run.bounds.of(check.code)) for check in checks_of(run.kind)}),
        baseline_number=None if newest is None else newest.number,
        software=__version__,
        created_at=datetime.now(UTC),
    )
    db.add(row)
    db.flush()
    detail: dict[str, object] = {
        "run_id": row.id,
        "kind": row.kind,
        "request": run.request,
        "baseline_number": row.baseline_number,
    }
    detail |= {"is_simulated": run.is_simulated, "is_simulated_beam": run.is_simulated_beam}
    detail["plate_sha256"] = run.plate_sha256
    audit.append(db, Event(actor=run.operator, action=START, detail=detail))
    return row


def end(db: Session, run_id: str, outcome: QaOutcome) -> None:
    """Store the outcome and results of a run and audit them with the hash of the results."""
    run = run_row(db, run_id)
    report = None if outcome.report is None else _with_treatments(db, run, outcome.report)
    rows = [] if report is None else [_result(run_id, number, one) for number, one in enumerate(report.results)]
    db.add_all(rows)
    db.flush()
    sha256 = results_sha256(rows)
    verdict = None if report is None else report.verdict.value
    series = [] if report is None else [asdict(one) for one in report.series]
    db.add(
        QaOutcomeRow(
            run_id=run_id,
            status=outcome.status,
            status_detail=outcome.detail,
            verdict=verdict,
            series=json.dumps(series, allow_nan=False, separators=(",", ":")),
            sha256=sha256,
            ended_at=datetime.now(UTC),
        )
    )
    detail = {
        "run_id": run_id,
        "kind": run.kind,
        "status": outcome.status,
        "detail": outcome.detail,
        "verdict": verdict,
        "results_sha256": sha256,
        "is_simulated": run.is_simulated,
        "not_passed": {row.code: row.verdict for row in rows if row.verdict != "pass"},
    }
    done: audit.Outcome = "done" if outcome.status == "finished" else "failed"
    audit.append(db, Event(actor=run.operator, action=END, outcome=done, detail=detail))


def _with_treatments(db: Session, run: QaRunRow, report: QaReport) -> QaReport:
    """Add the holds of the treatments since the last run; a simulated run has none."""
    bound = json.loads(run.bounds).get(TREATMENTS)
    if run.is_simulated or bound is None:
        return report
    figures = treatment_figures(db, is_simulated_beam=run.is_simulated_beam)
    judged = [judge(figure, check_of(TREATMENTS), QaBound(**bound)) for figure in figures]
    measured = [result for result in report.results if result.code != TREATMENTS]
    return replace(report, results=(*measured, *judged))


def results_sha256(rows: Sequence[QaResultRow]) -> str:
    """Return the SHA-256 of stored results, hexadecimal."""
    content = [
        [row.code, row.value, row.expected, row.deviation, row.uncertainty, row.warn, row.fail, row.verdict, row.detail]
        for row in rows
    ]
    return hashlib.sha256(audit.canonical_json(content).encode()).hexdigest()


def run_row(db: Session, run_id: str) -> QaRunRow:
    """Return the row of a run; raise NotFoundError if there is none."""
    row = db.get(QaRunRow, run_id)
    if row is None:
        msg = "there is no such QA run"
        raise NotFoundError(msg, field="run_id", value=run_id)
    return row


def outcome_row(db: Session, run_id: str) -> QaOutcomeRow | None:
    """Return the outcome of a run; None before its end."""
    return db.get(QaOutcomeRow, run_id)


def result_rows(db: Session, run_id: str) -> Sequence[QaResultRow]:
    """Return a run's results in the order of the report."""
    query = select(QaResultRow).where(QaResultRow.run_id == run_id)
    return db.scalars(query.order_by(QaResultRow.position)).all()


def run_page(
    db: Session, cursor: str | None, limit: int, filters: QaRunFilter = ALL_RUNS
) -> tuple[Sequence[QaRunRow], str | None]:
    """Return a page of runs, newest first, and the cursor of the next page."""
    conditions = [] if filters.kind is None else [QaRunRow.kind == filters.kind]
    if filters.verdict is not None:
        judged = select(QaOutcomeRow.run_id).where(QaOutcomeRow.verdict == filters.verdict)
        conditions.append(QaRunRow.id.in_(judged))
    return queries.newest_first(db, QaRunRow, cursor, limit, conditions)


def unended_runs(db: Session) -> Sequence[QaRunRow]:
    """Return the runs without an outcome."""
    ended = select(QaOutcomeRow.run_id)
    return db.scalars(select(QaRunRow).where(QaRunRow.id.not_in(ended))).all()


def newest_run(db: Session, kinds: Sequence[str]) -> QaRunRow | None:
    """Return the newest run of these kinds, with any outcome; simulated runs do not count."""
    query = select(QaRunRow).where(QaRunRow.kind.in_(kinds), QaRunRow.is_simulated.is_(False))
    return db.scalars(query.order_by(QaRunRow.created_at.desc(), QaRunRow.id.desc()).limit(1)).first()


def plate_recorded_since(db: Session, run: QaRunRow) -> datetime:
    """Return when the plate's recording of this run was first judged, the upper bound of its date."""
    if run.plate_sha256 is None:
        return run.created_at
    query = select(QaRunRow.created_at).where(QaRunRow.plate_sha256 == run.plate_sha256)
    seen: list[datetime] = [run.created_at, *db.scalars(query)]
    return min(seen)


def trend_rows(
    db: Session, code: str, limit: int, *, before: QaRunRow | None = None
) -> list[tuple[QaRunRow, QaResultRow]]:
    """Return a check's newest results, oldest first, without simulated runs and runs after ``before``."""
    query = select(QaRunRow, QaResultRow).join(QaResultRow, QaResultRow.run_id == QaRunRow.id)
    query = query.join(QaOutcomeRow, QaOutcomeRow.run_id == QaRunRow.id)
    query = query.where(QaResultRow.code == code)
    if before is None or not before.is_simulated:
        query = query.where(QaRunRow.is_simulated.is_(False))
    if before is not None:
        newest = tuple_(literal(before.created_at, UtcTime), literal(before.id))
        query = query.where(tuple_(QaRunRow.created_at, QaRunRow.id) <= newest)
    rows = db.execute(query.order_by(QaRunRow.created_at.desc(), QaRunRow.id.desc()).limit(limit)).all()
    return [(run, result) for run, result in reversed(rows)]


def newest_baseline(db: Session) -> QaBaselineRow | None:
    """Return the current baseline, or None."""
    return db.scalars(select(QaBaselineRow).order_by(QaBaselineRow.number.desc()).limit(1)).first()


def baseline_rows(db: Session) -> Sequence[QaBaselineRow]:
    """Return all baselines, newest first."""
    return db.scalars(select(QaBaselineRow).order_by(QaBaselineRow.number.desc())).all()


def baseline_of(row: QaBaselineRow | None) -> QaBaseline:
    """Return a baseline as an engine value; empty for None."""
    return QaBaseline(expected={} if row is None else json.loads(row.expected))


def fix_baseline(db: Session, expected: Mapping[str, float], *, operator: str, reason: str) -> QaBaselineRow:
    """Add and audit a baseline; a value not in ``expected`` is taken from the previous one."""
    before = newest_baseline(db)
    earlier = dict(baseline_of(before).expected)
    fixed = QaBaseline(expected={**earlier, **expected})
    row = QaBaselineRow(
        number=1 if before is None else before.number + 1,
        expected=audit.canonical_json(dict(fixed.expected)),
        set_by=operator,
        reason=reason,
        created_at=datetime.now(UTC),
    )
    db.add(row)
    db.flush()
    detail = {"number": row.number, "expected": dict(fixed.expected), "before": earlier, "reason": reason}
    audit.append(db, Event(actor=operator, action=BASELINE, detail=detail))
    return row


def _result(run_id: str, position: int, result: QaResult) -> QaResultRow:
    return QaResultRow(
        run_id=run_id,
        position=position,
        code=result.code,
        value=_finite(result.value),
        unit=result.unit,
        expected=_finite(result.expected),
        deviation=_finite(result.deviation),
        uncertainty=_finite(result.uncertainty),
        warn=result.warn,
        fail=result.fail,
        verdict=result.verdict.value,
        detail=result.detail,
    )


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
