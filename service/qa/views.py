"""Convert QA rows of the database to answers."""

import json
from collections.abc import Sequence

from sqlalchemy.orm import Session

from engine.qa import CHECKS, QaCheck, QaNeed, check_of
from service.core.conditional import etag_of
from service.core.settings.qa import QaSettings, setting_of
from service.qa import queries, schemas
from service.storage.database.tables import QaBaselineRow, QaResultRow, QaRunRow

INTERRUPTED = "the program ended during this run"
Progress = tuple[QaNeed, int, int | None]


def run_answer(db: Session, row: QaRunRow, *, is_under_way: bool, progress: Progress | None = None) -> schemas.QaRun:
    """Return a run; one without an outcome that is not in progress counts as interrupted."""
    outcome = queries.outcome_row(db, row.id)
    status, detail = "interrupted", INTERRUPTED
    if outcome is not None:
        status, detail = outcome.status, outcome.status_detail
    elif is_under_way:
        status, detail = "running", ""
    shown = None if progress is None or outcome is not None else progress
    return schemas.QaRun.model_validate(
        {
            **{name: getattr(row, name) for name in ("id", "kind", "operator", "site", "machine", "software")},
            **{name: getattr(row, name) for name in ("is_simulated", "is_simulated_beam", "created_at")},
            "status": status,
            "status_detail": detail,
            "verdict": None if outcome is None else outcome.verdict,
            "ended_at": None if outcome is None else outcome.ended_at,
            "progress": None if shown is None else {"stage": shown[0].value, "done": shown[1], "total": shown[2]},
        }
    )


def baseline_etag(number: int) -> str:
    """Return the ETag of a baseline, derived from its number."""
    return etag_of("qa baseline", number)


def run_detail(
    db: Session, row: QaRunRow, *, is_under_way: bool, progress: Progress | None = None
) -> schemas.QaRunDetail:
    """Return a run with its checks and plot data."""
    run = run_answer(db, row, is_under_way=is_under_way, progress=progress)
    outcome = queries.outcome_row(db, row.id)
    request = json.loads(row.request)
    return schemas.QaRunDetail.model_validate(
        {
            **run.model_dump(),
            "note": request.get("note", ""),
            "calibration_sha256": request.get("calibration_sha256"),
            "baseline_number": row.baseline_number,
            "results": [result_answer(one) for one in queries.result_rows(db, row.id)],
            "series": [] if outcome is None else json.loads(outcome.series),
            "sha256": None if outcome is None else outcome.sha256,
        }
    )


def result_answer(row: QaResultRow) -> schemas.QaResult:
    """Return a judged check: current title, values and bounds as stored."""
    check = check_of(row.code)
    names = schemas.QaResult.model_fields.keys() - {"title", "sidedness"}
    stored = {name: getattr(row, name) for name in names}
    return schemas.QaResult.model_validate({**stored, "title": check.title, "sidedness": check.sidedness.value})


def trend_answer(db: Session, code: str, limit: int, *, before: QaRunRow | None = None) -> schemas.QaTrend:
    """Return the values of a check in the newest ``limit`` runs, oldest first."""
    check = check_of(code)
    same = ("value", "expected", "deviation", "warn", "fail", "verdict")
    points = [
        {"run_id": run.id, "kind": run.kind, "at": run.created_at, **{name: getattr(one, name) for name in same}}
        for run, one in queries.trend_rows(db, code, limit, before=before)
    ]
    return schemas.QaTrend.model_validate(
        {"check": code, "title": check.title, "unit": check.unit, "sidedness": check.sidedness.value, "items": points}
    )


def check_list(settings: QaSettings) -> schemas.QaCheckList:
    """Return all checks with a site's bounds."""
    return schemas.QaCheckList(items=[_check(check, settings) for check in CHECKS])


def baseline_answer(row: QaBaselineRow | None) -> schemas.QaBaseline:
    """Return a baseline; number 0 if none is set yet."""
    if row is None:
        return schemas.QaBaseline(number=0, expected={}, set_by="", reason="", created_at=None)
    return schemas.QaBaseline(
        number=row.number,
        expected=dict(queries.baseline_of(row).expected),
        set_by=row.set_by,
        reason=row.reason,
        created_at=row.created_at,
    )


def baseline_history(rows: Sequence[QaBaselineRow]) -> schemas.QaBaselineHistory:
    """Return the current baseline, the first of ``rows``, and the earlier ones."""
    current = baseline_answer(rows[0] if rows else None).model_dump()
    return schemas.QaBaselineHistory(**current, earlier=[baseline_answer(row) for row in rows[1:]])


def _check(check: QaCheck, settings: QaSettings) -> schemas.QaCheck:
    bound = settings.qa_bounds.of(check.code)
    same = ("code", "title", "unit", "method", "expected", "has_baseline", "most", "source")
    return schemas.QaCheck.model_validate(
        {
            **{name: getattr(check, name) for name in same},
            "needs": check.needs.value,
            "kinds": [kind.value for kind in check.kinds],
            "sidedness": check.sidedness.value,
            "warn": bound.warn,
            "fail": bound.fail,
            "warn_setting": f"qa.{setting_of(check.code, 'warn')}",
            "fail_setting": f"qa.{setting_of(check.code, 'fail')}",
        }
    )
