"""Builds the application: routers, middleware, page, error handlers. A factory, so that tests can build several."""

import asyncio
import functools
import re
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from importlib.resources import files
from pathlib import Path

import anyio
import anyio.to_thread
from fastapi import APIRouter, Depends, FastAPI
from fastapi.staticfiles import StaticFiles
from sqlalchemy.exc import SQLAlchemyError
from starlette.middleware import Middleware
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from engine import __version__
from engine.core.errors import TidegateError
from service.access.accounts.people import OnFirstAdmin
from service.access.request.addresses import ClientAddresses
from service.core.settings.groups import ConnectionLimits
from service.core.settings.settings import Settings
from service.engine_host.local_engine import LocalEngine
from service.engine_host.protocols import EnginePort
from service.monitoring.certificate import ServedCertificate
from service.qa.jobs import QaRig
from service.qa.late_rig import LateRig
from service.storage.database.startup import SAMPLES_FOLDER
from service.storage.samples.store import SampleStore
from service.storage.samples.tail import SampleTails
from service.web.api import (
    audit,
    calibrations,
    coaching,
    devices,
    health,
    interlocks,
    keys,
    login,
    login_oidc,
    metrics,
    models,
    pacs,
    plans,
    qa,
    recordings,
    sessions,
    users,
)
from service.web.api.problem_handlers import install_problem_handlers
from service.web.api.route_problems import document_problems
from service.web.container import Container, open_container
from service.web.dependencies import guarded, require_json
from service.web.middleware.guard import Guard
from service.web.middleware.request_log import Arrival, RequestLog
from service.web.middleware.requests import (
    DOCS,
    MAX_BODY_BYTES,
    MAX_PLAN_BYTES,
    RequestMiddleware,
    require_acceptable,
    require_known_query,
)
from service.web.middleware.reserved_threads import ReservedThreads
from service.web.openapi import describe_contract, operation_id
from service.web.stream import coach_hub, server_sent_events, websocket
from service.web.stream.coach_hub import CoachHub
from service.web.stream.hub import LiveHub
from service.web.stream.metrics import StreamMetrics
from service.web.stream.resume import Resumption

TURN_S = 0.03
STALL_S = 5.0
"""A client that reads nothing for this time is disconnected."""
RESUME_S = 600.0
"""Longest part of the record that is resent to a client that reconnects."""
"""Period of reporting that the event loop turns; as short as that of the heartbeats that carry it."""
LANGUAGE_LIST = "/lang/index.json"
_NAME = re.compile(r"[a-z]{2}(-[A-Z]{2})?")
DASHBOARD = Path(str(files("service.web"))) / "dashboard"
PATIENT = "/patient"
"""Address of the patient screen's page."""
OFFICE = "/office"
"""Address of the page of everything that is not done at the patient: past sessions, plans, QA, models, audit."""
PLAN_IMPORT = ("POST", "/api/v1/plans")
SIMULATION = ("POST", "/api/v1/sessions/{session_id}/simulation")
STRICT = (require_known_query, require_acceptable, require_json)
DESCRIPTION = """Respiratory gating for research and commissioning; **not cleared for clinical use**.

No call switches the beam on: a call can only arm the gate, which then decides. The exception is QA on a real beam
line: a physicist with a one-time code from the machine, while no session is created or running. Lengths are mm,
volumes l, times RFC 3339 UTC; motion is positive towards the camera (inhale). Errors are RFC 9457 problems with a
stable `code`, and with `field`, `value` and `bound` if a value broke a bound.

People log in and use a cookie; machines send an API key as `Authorization: Bearer tg_...`. `x-permission` of an
operation is the permission it needs. A call of a person acts in the name of the log-in, and `operator` may be left out
of its body; an API key sends in `operator` the name of the person it acts for."""


# The application's start and stop; at the stop the beam is held before anything is closed.
async def report_turns(note: Callable[[int], None]) -> None:
    """Report each turn of the running event loop with its time [ns, host monotonic], until cancelled."""
    while True:
        note(time.monotonic_ns())
        await asyncio.sleep(TURN_S)


def make_lifespan(
    settings: Settings,
    make_engine: Callable[[Settings], EnginePort],
    make_rig: Callable[[Settings], QaRig],
    tell_first: OnFirstAdmin | None = None,
    certificate: ServedCertificate | None = None,
) -> Callable[[FastAPI], AbstractAsyncContextManager[None]]:
    """Make the application's lifespan."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        try:
            container = await anyio.to_thread.run_sync(
                open_container, settings, make_engine(settings), make_rig(settings), tell_first, certificate
            )
        except (TidegateError, SQLAlchemyError) as error:
            app.state.start_refusal = _refusal(error)
            raise
        _install(app, container, settings)
        turns = asyncio.create_task(report_turns(container.services.engine.note_server_turn))
        try:
            yield
        finally:
            with anyio.CancelScope(shield=True):
                # A reserved thread: calls that hang in all ordinary threads cannot keep the container open.
                await anyio.to_thread.run_sync(container.close, limiter=anyio.CapacityLimiter(1))
            turns.cancel()

    return lifespan


def _install(app: FastAPI, container: Container, settings: Settings) -> None:
    """Put the services where dependencies and streams find them: on the application."""
    app.state.services = container.services
    app.state.http_tallies = container.monitoring.http
    app.state.access = container.access.service
    app.state.oidc = container.access.oidc
    app.state.armed_operator = container.access.armed_operator
    app.state.alarm_watch = container.storage.alarms
    app.state.hold_and_close_session = container.hold_and_close_session
    app.state.live = LiveHub(
        container.services.runner,
        container.services.alarms,
        max_clients=settings.max_live_clients,
        stall_s=STALL_S,
        room=settings.room,
    )
    app.state.coach = CoachHub(container.services.runner, container.services.coaching, stall_s=STALL_S)
    container.monitoring.metrics.add(StreamMetrics(app.state.live.reading))
    tails = SampleTails(SampleStore(settings.data_dir / SAMPLES_FOLDER))
    app.state.resumption = Resumption(tails, longest_s=RESUME_S)


def _refusal(error: TidegateError | SQLAlchemyError) -> str:
    """Return why the start failed, for the log; a database driver's own message may hold secrets."""
    if isinstance(error, SQLAlchemyError):
        return f"the database does not answer, or not as it should ({type(error).__name__})"
    return str(error)


# The languages of the page: the files of ``dashboard/lang``, listed for the page; a new language is a new file.
def language_names(dashboard: Path) -> list[str]:
    """Return the languages that have a file, in alphabetical order; files with other names are none."""
    return sorted(file.stem for file in (dashboard / "lang").glob("*.json") if _NAME.fullmatch(file.stem))


def has_docs(dashboard: Path) -> bool:
    """Return whether the documentation is served beside the page."""
    return (dashboard / DOCS[1:] / "index.html").is_file()


def language_route(dashboard: Path) -> Route:
    """Make the route that lists the languages to the page, and says whether there is documentation."""
    answer = {"languages": language_names(dashboard), "has_docs": has_docs(dashboard)}

    async def listed(_: object) -> Response:
        return JSONResponse(answer)

    return Route(LANGUAGE_LIST, listed, name="languages")


def create_app(
    settings: Settings,
    make_engine: Callable[[Settings], EnginePort] = LocalEngine,
    make_rig: Callable[[Settings], QaRig] = LateRig,
    tell_first: OnFirstAdmin | None = None,
    connection_limits: ConnectionLimits | None = None,
) -> FastAPI:
    """Make the application; nothing is opened before its lifespan begins.

    ``tell_first`` is called with name and password of the administrator that is made if there is no account yet;
    without it none is made. The site's TLS certificate is ``app.state.certificate``, None without one.

    Raises
    ------
    CertificateError
        The certificate or its key cannot be used.
    """
    certificate = ServedCertificate.of(settings)
    app = FastAPI(
        title="Tidegate",
        version=__version__,
        description=DESCRIPTION,
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        openapi_url="/api/v1/openapi.json",
        generate_unique_id_function=operation_id,
        docs_url=None,
        redoc_url=None,
        routes=list(_api_routes()),
        lifespan=make_lifespan(settings, make_engine, make_rig, tell_first, certificate),
        middleware=[
            Middleware(Arrival),
            Middleware(RequestLog, page_files=_page_files()),
            Middleware(
                RequestMiddleware,
                host_names=settings.host_names,
                max_body_bytes=MAX_BODY_BYTES,
                max_body_s=(connection_limits or ConnectionLimits()).body_s,
                larger_bodies={PLAN_IMPORT: MAX_PLAN_BYTES, SIMULATION: MAX_PLAN_BYTES},
            ),
            Middleware(
                Guard,
                callers=ClientAddresses(behind_proxy=settings.behind_proxy, trusted_proxies=settings.trusted_proxies),
                allowed_origins=settings.allowed_origins,
                is_secure=settings.is_secure,
                page_files=_page_files(),
                nothing=DASHBOARD / "nothing.html",
            ),
        ],
    )
    app.state.own_threads = ReservedThreads()
    app.state.certificate = certificate
    install_problem_handlers(app)
    describe_contract(app)
    app.router.routes.append(language_route(DASHBOARD))
    app.mount("/", StaticFiles(directory=DASHBOARD, html=True, check_dir=False), name="page")
    return app


@functools.cache
def _api_routes() -> tuple[BaseRoute, ...]:
    """Return the routes of the API: every application of this process has the same, so FastAPI analyses them once."""
    root = APIRouter(generate_unique_id_function=operation_id)
    is_guarded = Depends(guarded)
    root.include_router(health.router, dependencies=[is_guarded])
    root.include_router(metrics.router, dependencies=[is_guarded])
    api = APIRouter(prefix="/api/v1", dependencies=[is_guarded, *map(Depends, STRICT)])
    api.include_router(health.machine_router)
    for module in (
        login,
        login_oidc,
        users,
        keys,
        sessions,
        coaching,
        plans,
        models,
        calibrations,
        devices,
        recordings,
        pacs,
        interlocks,
        audit,
        qa,
        server_sent_events,
    ):
        document_problems(module.router.routes)
        api.include_router(module.router)
    root.include_router(api)
    root.include_router(websocket.router, prefix="/api/v1")
    root.include_router(coach_hub.router, prefix="/api/v1")
    return tuple(root.routes)


@functools.cache
def _page_files() -> frozenset[str]:
    """Return the paths of the page's files, listed once per process: no data, and all that is read without a rule."""
    found = (file.relative_to(DASHBOARD).as_posix() for file in DASHBOARD.rglob("*") if file.is_file())
    folders = (PATIENT, OFFICE, *((DOCS,) if has_docs(DASHBOARD) else ()))
    pages = {path for folder in folders for path in (folder, f"{folder}/")}
    return frozenset({"/", LANGUAGE_LIST, *pages, *(f"/{path}" for path in found)})
