"""What happens at start and at the end; on the way out the beam is held before anything is closed."""

from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager

import anyio
import anyio.to_thread
from fastapi import FastAPI
from sqlalchemy.exc import SQLAlchemyError

from engine.errors import TidegateError
from service.access.first import TellFirst
from service.db.preparing import SAMPLES_FOLDER
from service.house import House, open_house
from service.ports import EnginePort
from service.qa.ports import QaRig
from service.samples.shelf import SampleShelf
from service.samples.tail import SampleTails
from service.settings import Settings
from service.stream.hub import LiveHub
from service.stream.resuming import Resumption
from service.stream_metrics import StreamMetrics


def make_lifespan(
    settings: Settings,
    make_engine: Callable[[Settings], EnginePort],
    make_rig: Callable[[Settings], QaRig],
    tell_first: TellFirst | None = None,
) -> Callable[[FastAPI], AbstractAsyncContextManager[None]]:
    """Make the application's lifespan."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        try:
            house = await anyio.to_thread.run_sync(
                open_house, settings, make_engine(settings), make_rig(settings), tell_first
            )
        except (TidegateError, SQLAlchemyError) as error:
            app.state.start_refusal = _refusal(error)
            raise
        _move_in(app, house, settings)
        try:
            yield
        finally:
            with anyio.CancelScope(shield=True):
                # A thread of its own: calls that hang in all the others keep the house from being closed by none.
                await anyio.to_thread.run_sync(house.close, limiter=anyio.CapacityLimiter(1))

    return lifespan


def _move_in(app: FastAPI, house: House, settings: Settings) -> None:
    """Put what calls and streams ask for where they look for it."""
    app.state.services = house.services
    app.state.http_tallies = house.watching.http
    app.state.access = house.people.access
    app.state.oidc = house.people.oidc
    app.state.attendance = house.people.attendance
    app.state.hold_and_close_session = house.hold_and_close_session
    app.state.live = LiveHub(
        house.services.runner, max_clients=settings.max_live_clients, stall_s=settings.live_stall_s
    )
    house.watching.metrics.add(StreamMetrics(app.state.live.reading))
    tails = SampleTails(SampleShelf(settings.data_dir / SAMPLES_FOLDER))
    app.state.resumption = Resumption(tails, longest_s=settings.live_resume_s)


def _refusal(error: TidegateError | SQLAlchemyError) -> str:
    """Say why nothing was started; what a driver says may hold more than a log should."""
    if isinstance(error, SQLAlchemyError):
        return f"the database does not answer, or not as it should ({type(error).__name__})"
    return str(error)
