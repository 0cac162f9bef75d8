"""The application: routers, page, door, problems. Made by a function, so that tests make as many as they like."""

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

from fastapi import APIRouter, Depends, FastAPI
from fastapi.staticfiles import StaticFiles
from starlette.middleware import Middleware

from engine import __version__
from service.api import audit, calibrations, devices, health, interlocks, metrics, models, qa, sessions
from service.deps import require_json
from service.engine_adapter import EngineAdapter
from service.lifespan import make_lifespan
from service.middleware import Doorway
from service.openapi import describe_problems
from service.ports import EnginePort
from service.problem_handlers import install_problem_handlers
from service.qa.ports import QaRig
from service.qa.rig import EngineRig
from service.settings import Settings
from service.ws import live

DESCRIPTION = """Respiratory gating for research and commissioning; **not cleared for clinical use**.

No call can turn a beam on: calls can only arm, which lets the gate decide. Lengths are mm, volumes l, times RFC 3339
UTC; motion is positive towards the camera (inhale). Errors are RFC 9457 problems with a stable `code`, and `field`,
`value` and `bound` where one was broken. This version has no users and passwords: keep it on this machine."""


def create_app(
    settings: Settings,
    make_engine: Callable[[Settings], EnginePort] = EngineAdapter,
    make_rig: Callable[[Settings], QaRig] = EngineRig,
) -> FastAPI:
    """Make the application; nothing is opened before its lifespan begins."""
    app = FastAPI(
        title="Tidegate",
        version=__version__,
        description=DESCRIPTION,
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        openapi_url="/api/v1/openapi.json",
        docs_url=None,
        redoc_url=None,
        lifespan=make_lifespan(settings, make_engine, make_rig),
        middleware=[Middleware(Doorway, host_names=settings.host_names, max_body_bytes=settings.max_body_bytes)],
    )
    install_problem_handlers(app)
    describe_problems(app)
    app.include_router(health.router)
    app.include_router(metrics.router)
    api = APIRouter(prefix="/api/v1", dependencies=[Depends(require_json)])
    for module in (sessions, models, calibrations, devices, interlocks, audit, qa):
        api.include_router(module.router)
    app.include_router(api)
    app.include_router(live.router, prefix="/api/v1")
    dashboard = Path(str(files("service"))) / "dashboard"
    app.mount("/", StaticFiles(directory=dashboard, html=True, check_dir=False), name="page")
    return app
