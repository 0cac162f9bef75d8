"""The application's start and stop; at the stop the beam is held before anything is closed."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager

import anyio
import anyio.to_thread
from fastapi import FastAPI
from sqlalchemy.exc import SQLAlchemyError

from engine.core.errors import TidegateError
from service.access.accounts.first_admin import OnFirstAdmin
from service.core.settings.settings import Settings
from service.engine_host.roles import EnginePort
from service.monitoring.certificate import ServedCertificate
from service.qa.roles import QaRig
from service.storage.database.startup import SAMPLES_FOLDER
from service.storage.samples.store import SampleStore
from service.storage.samples.tail import SampleTails
from service.web.container import Container, open_container
from service.web.stream.coach_hub import CoachHub
from service.web.stream.hub import LiveHub
from service.web.stream.metrics import StreamMetrics
from service.web.stream.resume import Resumption

TURN_S = 0.03
"""Period of reporting that the event loop turns; as short as that of the heartbeats that carry it."""


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
        stall_s=settings.live_stall_s,
        room=settings.room,
    )
    app.state.coach = CoachHub(container.services.runner, container.services.coaching, stall_s=settings.live_stall_s)
    container.monitoring.metrics.add(StreamMetrics(app.state.live.reading))
    tails = SampleTails(SampleStore(settings.data_dir / SAMPLES_FOLDER))
    app.state.resumption = Resumption(tails, longest_s=settings.live_resume_s)


def _refusal(error: TidegateError | SQLAlchemyError) -> str:
    """Return why the start failed, for the log; a database driver's own message may hold secrets."""
    if isinstance(error, SQLAlchemyError):
        return f"the database does not answer, or not as it should ({type(error).__name__})"
    return str(error)
