"""QA: runs, reports, trends, the checks, the baseline. Runs permit the beam: only on the word that it is safe."""

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Path, Query, Response

from engine.errors import BeamLineError, CalibrationError, RecordingError, RuntimeMissingError, SourceLostError
from service import deps
from service.api import problems
from service.conditional import etag_of
from service.errors import (
    BoundError,
    NotFoundError,
    OperatorMismatchError,
    QaActiveError,
    QaStateError,
    ServiceStoppingError,
    SessionActiveError,
)
from service.list_filters import QaRunFilter
from service.qa import schemas as qa
from service.qa.views import baseline_etag
from service.schema_base import Identifier

router = APIRouter(prefix="/qa", tags=["qa"])
READ = problems(NotFoundError)
START = problems(
    NotFoundError,
    BoundError,
    OperatorMismatchError,
    CalibrationError,
    RecordingError,
    QaActiveError,
    SessionActiveError,
    ServiceStoppingError,
    RuntimeMissingError,
    SourceLostError,
    BeamLineError,
)
FIX = problems(NotFoundError, BoundError, OperatorMismatchError, QaActiveError, QaStateError)
RunId = Annotated[Identifier, Path(description="The QA run's id")]
Check = Annotated[
    str,
    Query(
        min_length=1,
        max_length=48,
        pattern=r"^[a-z0-9_]+$",
        examples=["camera_distance_mm"],
        description="One of the codes that /qa/checks lists",
    ),
]
TrendLimit = Annotated[int, Query(ge=1, le=500, description="Most runs")]


@router.post("/runs", status_code=202, name="qa.start", responses=START)
def start_qa_run(
    request: qa.QaRunRequest,
    caller: deps.Caller,
    services: deps.Offered,
    response: Response,
    idempotency_key: deps.IdempotencyKey = None,
) -> qa.QaRun:
    """Begin a run; one at a time, and never while a session runs. Its drills PERMIT THE BEAM of a real line."""
    named = request.model_copy(update={"operator": caller.acts_as(request.operator)})
    kept = services.qa_desk.start(named, idempotency_key)
    if kept.is_replay:
        response.headers["Idempotency-Replayed"] = "true"
    return kept.answer


@router.get("/runs")
def list_qa_runs(
    services: deps.Offered,
    pages: deps.Pages50,
    kind: Annotated[qa.Kind | None, Query(description="Only those of this kind")] = None,
    verdict: Annotated[qa.Verdict | None, Query(description="Only those that were judged so")] = None,
) -> qa.QaRunPage:
    """List runs, newest first."""
    return pages.told(services.qa_book.page(pages.cursor, pages.limit, QaRunFilter(kind=kind, verdict=verdict)))


@router.get("/runs/{run_id}", responses=READ)
def read_qa_run(run_id: RunId, services: deps.Offered, fresh: deps.IfNoneMatch) -> qa.QaRunDetail:
    """Read a run with every check, or how far it has come."""
    detail = services.qa_book.detail(run_id)
    return fresh.told(detail, etag_of("qa run", detail.model_dump(mode="json")))


@router.post("/runs/{run_id}/cancel", name="qa.cancel", responses=problems(NotFoundError, QaStateError))
async def cancel_qa_run(
    run_id: RunId, operator: deps.Obeyed, services: deps.Offered, threads: deps.Undelayed
) -> qa.QaRun:
    """Hold the beam line, then end the run."""
    call = partial(services.qa_desk.cancel, run_id, operator)
    return await threads.run(call, takes=services.qa_desk.is_under_way(run_id))


@router.get(
    "/runs/{run_id}/report.pdf",
    response_class=Response,
    responses={
        200: {"description": "The report", "content": {"application/pdf": {}}},
        **problems(NotFoundError, QaStateError),
    },
)
def read_qa_report(run_id: RunId, services: deps.Offered, caller: deps.Caller) -> Response:
    """Print a finished run: the checks, their trends, and what the plots show."""
    headers = {"Content-Disposition": f'inline; filename="qa-{run_id}.pdf"'}
    report = services.qa_book.report_pdf(run_id)
    services.audit.exported(actor=caller.name, action="qa.export", session_id=None, detail={"run_id": run_id})
    return Response(report, media_type="application/pdf", headers=headers)


@router.get("/trend")
def read_qa_trend(services: deps.Offered, check: Check, limit: TrendLimit = 30) -> qa.QaTrend:
    """Tell a check over the newest runs, oldest first; simulated runs are left out."""
    return services.qa_book.trend(check, limit)


@router.get("/checks")
def list_qa_checks(services: deps.Offered) -> qa.QaCheckList:
    """List what is checked, how, by which bounds of this site, and where they come from."""
    return services.qa_book.checks()


@router.get("/status")
def read_qa_status(services: deps.Offered) -> qa.QaStatus:
    """Tell the newest run of each kind, and whether the site's QA lets anybody arm."""
    return services.qa_book.status()


@router.get("/baseline")
def read_qa_baseline(services: deps.Offered, fresh: deps.IfNoneMatch) -> qa.QaBaselineHistory:
    """Tell what the camera's place should read, who fixed it, and what it was before."""
    history = services.qa_book.baseline()
    return fresh.told(history, baseline_etag(history.number))


@router.put("/baseline", name="qa.baseline", responses=FIX)
def fix_qa_baseline(
    request: qa.QaBaselineRequest,
    caller: deps.Caller,
    services: deps.Offered,
    if_match: deps.IfMatch,
    response: Response,
) -> qa.QaBaseline:
    """Fix what the camera's place should read; audited with what it was before."""
    named = request.model_copy(update={"operator": caller.acts_as(request.operator)})
    fixed = services.qa_book.fix_baseline(named, if_match)
    response.headers["ETag"] = baseline_etag(fixed.number)
    return fixed
