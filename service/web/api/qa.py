"""Routes of QA: runs, reports, trends, checks, baseline. A run permits the beam and needs a safety confirmation."""

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Path, Query, Response

from service.core.conditional import etag_of
from service.core.list_filters import QaRunFilter
from service.core.schemas.base import Identifier
from service.qa import schemas as qa
from service.qa.latency.schemas import CameraLatencyList
from service.qa.views import baseline_etag
from service.web import dependencies

router = APIRouter(prefix="/qa", tags=["qa"])
RunId = Annotated[Identifier, Path(description="Id of the QA run")]
Check = Annotated[
    str,
    Query(
        min_length=1,
        max_length=48,
        pattern=r"^[a-z0-9_]+$",
        examples=["camera_distance_mm"],
        description="A code listed by /qa/checks",
    ),
]
TrendLimit = Annotated[int, Query(ge=1, le=500, description="Maximum number of runs")]


@router.post("/runs", status_code=202, name="qa.start")
def start_qa_run(
    request: qa.QaRunRequest,
    caller: dependencies.Caller,
    services: dependencies.AppServices,
    response: Response,
    idempotency_key: dependencies.IdempotencyKey = None,
) -> qa.QaRun:
    """Start a run; one at a time, and not while a session is created or running. For physicists, never for machines.

    Its drills PERMIT THE BEAM of a real line, which needs `is_beam_safe` and a one-time `code` from the machine.
    """
    named = request.model_copy(update={"operator": caller.checked_actor(request.operator)})
    return dependencies.created(services.qa_runs.start(named, idempotency_key), response)


@router.get("/runs")
def list_qa_runs(
    services: dependencies.AppServices,
    pages: dependencies.Pages50,
    kind: Annotated[qa.RunKind | None, Query(description="Only runs of this kind")] = None,
    verdict: Annotated[qa.Verdict | None, Query(description="Only runs with this verdict")] = None,
) -> qa.QaRunPage:
    """List runs, newest first."""
    return pages.answer(services.qa_archive.page(pages.cursor, pages.limit, QaRunFilter(kind=kind, verdict=verdict)))


@router.get("/runs/{run_id}")
def read_qa_run(run_id: RunId, services: dependencies.AppServices, fresh: dependencies.IfNoneMatch) -> qa.QaRunDetail:
    """Read a run with its checks, or its progress."""
    detail = services.qa_archive.detail(run_id)
    return fresh.answer(detail, etag_of("qa run", detail.model_dump(mode="json")))


@router.post("/runs/{run_id}/cancel", name="qa.cancel")
async def cancel_qa_run(
    run_id: RunId,
    operator: dependencies.WithdrawingOperator,
    services: dependencies.AppServices,
    threads: dependencies.WithdrawalThreads,
) -> qa.QaRun:
    """Cancel a run: hold the beam line, then end the run."""
    call = partial(services.qa_runs.cancel, run_id, operator)
    return await threads.run(call, takes=services.qa_runs.is_under_way(run_id))


@router.get(
    "/runs/{run_id}/report.pdf",
    response_class=Response,
    responses={
        200: {"description": "The report", "content": {"application/pdf": {}}},
    },
)
def read_qa_report(run_id: RunId, services: dependencies.AppServices, caller: dependencies.Caller) -> Response:
    """Return the PDF report of a finished run: checks, trends, plots."""
    headers = {"Content-Disposition": f'inline; filename="qa-{run_id}.pdf"'}
    report = services.qa_archive.report_pdf(run_id)
    services.audit.exported(actor=caller.name, action="qa.export", session_id=None, detail={"run_id": run_id})
    return Response(report, media_type="application/pdf", headers=headers)


@router.get("/trend")
def read_qa_trend(services: dependencies.AppServices, check: Check, limit: TrendLimit = 30) -> qa.QaTrend:
    """Return the trend of a check over the newest runs, oldest first, without simulated runs."""
    return services.qa_archive.trend(check, limit)


@router.get("/checks")
def list_qa_checks(services: dependencies.AppServices) -> qa.QaCheckList:
    """List the checks, with method, this site's bounds and their sources."""
    return services.qa_archive.checks()


@router.get("/status")
def read_qa_status(services: dependencies.AppServices) -> qa.QaStatus:
    """Return the newest run of each kind, and whether the site's QA rule allows arming."""
    return services.qa_archive.status()


@router.get("/latency")
def list_camera_latencies(services: dependencies.AppServices) -> CameraLatencyList:
    """List the newest measured latency of each camera and mode; `tidegate qa latency` measures at the machine."""
    return services.qa_archive.latencies()


@router.get("/baseline")
def read_qa_baseline(services: dependencies.AppServices, fresh: dependencies.IfNoneMatch) -> qa.QaBaselineHistory:
    """Return the expected camera position, who set it, and the value before."""
    history = services.qa_archive.baseline()
    return fresh.answer(history, baseline_etag(history.number))


@router.put("/baseline", name="qa.baseline")
def fix_qa_baseline(
    request: qa.QaBaselineRequest,
    caller: dependencies.Caller,
    services: dependencies.AppServices,
    if_match: dependencies.IfMatch,
    response: Response,
) -> qa.QaBaseline:
    """Set the expected camera position; audited with the value before."""
    named = request.model_copy(update={"operator": caller.checked_actor(request.operator)})
    fixed = services.qa_archive.fix_baseline(named, if_match)
    response.headers["ETag"] = baseline_etag(fixed.number)
    return fixed
