"""Builds the application: routers, middleware, page, error handlers. A factory, so that tests can build several."""

import functools
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

from fastapi import APIRouter, Depends, FastAPI
from fastapi.staticfiles import StaticFiles
from starlette.middleware import Middleware
from starlette.routing import BaseRoute

from engine import __version__
from service.access.accounts.first_admin import OnFirstAdmin
from service.access.request.addresses import ClientAddresses
from service.core.settings.settings import Settings
from service.engine_host.local_engine import LocalEngine
from service.engine_host.roles import EnginePort
from service.monitoring.certificate import ServedCertificate
from service.qa.late_rig import LateRig
from service.qa.roles import QaRig
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
    plans,
    qa,
    recordings,
    sessions,
    users,
)
from service.web.api.problem_handlers import install_problem_handlers
from service.web.dependencies import guarded, require_json
from service.web.languages import LANGUAGE_LIST, language_route
from service.web.lifespan import make_lifespan
from service.web.middleware.arrival import Arrival
from service.web.middleware.guard import Guard
from service.web.middleware.request_log import RequestLog
from service.web.middleware.requests import RequestMiddleware
from service.web.middleware.reserved_threads import ReservedThreads
from service.web.middleware.strict_requests import require_acceptable, require_known_query
from service.web.openapi import describe_contract, operation_id
from service.web.stream import coach, server_sent_events, websocket

DASHBOARD = Path(str(files("service.web"))) / "dashboard"
PATIENT = "/patient"
"""Address of the patient screen's page."""
PLAN_IMPORT = ("POST", "/api/v1/plans")
STRICT = (require_known_query, require_acceptable, require_json)
DESCRIPTION = """Respiratory gating for research and commissioning; **not cleared for clinical use**.

No call switches the beam on: a call can only arm the gate, which then decides. The exception is QA on a real beam
line: a physicist with a one-time code from the machine, while no session is created or running. Lengths are mm,
volumes l, times RFC 3339 UTC; motion is positive towards the camera (inhale). Errors are RFC 9457 problems with a
stable `code`, and with `field`, `value` and `bound` if a value broke a bound.

People log in and use a cookie; machines send an API key as `Authorization: Bearer tg_...`. `x-permission` of an
operation is the permission it needs. A call of a person acts in the name of the log-in, and `operator` may be left out
of its body; an API key sends in `operator` the name of the person it acts for."""


def create_app(
    settings: Settings,
    make_engine: Callable[[Settings], EnginePort] = LocalEngine,
    make_rig: Callable[[Settings], QaRig] = LateRig,
    tell_first: OnFirstAdmin | None = None,
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
                max_body_bytes=settings.max_body_bytes,
                max_body_s=settings.http_body_s,
                larger_bodies={PLAN_IMPORT: settings.max_plan_bytes},
            ),
            Middleware(
                Guard,
                callers=ClientAddresses(behind_proxy=settings.behind_proxy, trusted_proxies=settings.trusted_proxies),
                allowed_origins=settings.allowed_origins,
                is_secure=settings.is_secure,
                page_files=_page_files(),
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
        interlocks,
        audit,
        qa,
        server_sent_events,
    ):
        api.include_router(module.router)
    root.include_router(api)
    root.include_router(websocket.router, prefix="/api/v1")
    root.include_router(coach.router, prefix="/api/v1")
    return tuple(root.routes)


@functools.cache
def _page_files() -> frozenset[str]:
    """Return the paths of the page's files, listed once per process: no data, and all that is read without a rule."""
    found = (file.relative_to(DASHBOARD).as_posix() for file in DASHBOARD.rglob("*") if file.is_file())
    return frozenset({"/", LANGUAGE_LIST, PATIENT, f"{PATIENT}/", *(f"/{path}" for path in found)})
