"""The application: routers, page, door, problems. Made by a function, so that tests make as many as they like."""

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

from fastapi import APIRouter, Depends, FastAPI
from fastapi.staticfiles import StaticFiles
from starlette.middleware import Middleware

from engine import __version__
from service.access.addresses import Callers
from service.access.first import TellFirst
from service.access.guard import Guard
from service.api import (
    audit,
    calibrations,
    devices,
    health,
    interlocks,
    keys,
    live_events,
    login,
    login_oidc,
    metrics,
    models,
    plans,
    qa,
    sessions,
    users,
)
from service.arrival import Arrival
from service.deps import guarded, require_json
from service.engine_adapter import EngineAdapter
from service.lifespan import make_lifespan
from service.middleware import Doorway
from service.openapi import describe_contract, operation_id
from service.own_threads import OwnThreads
from service.ports import EnginePort
from service.problem_handlers import install_problem_handlers
from service.qa.ports import QaRig
from service.qa.rig import EngineRig
from service.request_watch import RequestWatch
from service.settings import Settings
from service.strictness import require_acceptable, require_known_query
from service.ws import live

DASHBOARD = Path(str(files("service"))) / "dashboard"
PLAN_IMPORT = ("POST", "/api/v1/plans")
STRICT = (require_known_query, require_acceptable, require_json)
DESCRIPTION = """Respiratory gating for research and commissioning; **not cleared for clinical use**.

No call can turn a beam on: calls can only arm, which lets the gate decide. Lengths are mm, volumes l, times RFC 3339
UTC; motion is positive towards the camera (inhale). Errors are RFC 9457 problems with a stable `code`, and `field`,
`value` and `bound` where one was broken.

People log in, and have a cookie; machines send a key as `Authorization: Bearer tg_...`. What a call needs stands with
it as `x-permission`. In whose name a call acts is whoever is logged in: `operator` may be left out of every body; from
a machine it says for whom it acts."""


def create_app(
    settings: Settings,
    make_engine: Callable[[Settings], EnginePort] = EngineAdapter,
    make_rig: Callable[[Settings], QaRig] = EngineRig,
    tell_first: TellFirst | None = None,
) -> FastAPI:
    """Make the application; nothing is opened before its lifespan begins.

    ``tell_first`` is told name and password of the administrator that is made where there is nobody yet; without it
    none is made.
    """
    app = FastAPI(
        title="Tidegate",
        version=__version__,
        description=DESCRIPTION,
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        openapi_url="/api/v1/openapi.json",
        generate_unique_id_function=operation_id,
        docs_url=None,
        redoc_url=None,
        lifespan=make_lifespan(settings, make_engine, make_rig, tell_first),
        middleware=[
            Middleware(Arrival),
            Middleware(RequestWatch, page_files=_page_files()),
            Middleware(
                Doorway,
                host_names=settings.host_names,
                max_body_bytes=settings.max_body_bytes,
                max_body_s=settings.http_body_s,
                larger_bodies={PLAN_IMPORT: settings.max_plan_bytes},
            ),
            Middleware(
                Guard,
                callers=Callers(behind_proxy=settings.behind_proxy, trusted_proxies=settings.trusted_proxies),
                allowed_origins=settings.allowed_origins,
                is_secure=settings.is_secure,
                page_files=_page_files(),
            ),
        ],
    )
    app.state.own_threads = OwnThreads()
    install_problem_handlers(app)
    describe_contract(app)
    is_guarded = Depends(guarded)
    app.include_router(health.router, dependencies=[is_guarded])
    app.include_router(metrics.router, dependencies=[is_guarded])
    api = APIRouter(prefix="/api/v1", dependencies=[is_guarded, *map(Depends, STRICT)])
    for module in (
        login,
        login_oidc,
        users,
        keys,
        sessions,
        plans,
        models,
        calibrations,
        devices,
        interlocks,
        audit,
        qa,
        live_events,
    ):
        api.include_router(module.router)
    app.include_router(api)
    app.include_router(live.router, prefix="/api/v1")
    app.mount("/", StaticFiles(directory=DASHBOARD, html=True, check_dir=False), name="page")
    return app


def _page_files() -> frozenset[str]:
    """Return the paths of the page's files: they hold no data, and are all that is read without a rule."""
    found = (file.relative_to(DASHBOARD).as_posix() for file in DASHBOARD.rglob("*") if file.is_file())
    return frozenset({"/", *(f"/{path}" for path in found)})
