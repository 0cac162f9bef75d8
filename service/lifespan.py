"""What happens at start and at the end; on the way out the beam is held before anything is closed."""

from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass

import anyio
import anyio.to_thread
from fastapi import FastAPI

from engine import __version__
from service.audit import SYSTEM, Event
from service.audit.care import AuditCare
from service.audit_log import AuditLog
from service.calibrations import CalibrationShelf
from service.db.engine import Database
from service.deps import Services
from service.interlocks import InterlockTable
from service.metrics import Metrics
from service.model_store import ModelStore
from service.motion_models import ModelShelf
from service.ports import EnginePort
from service.qa.book import QaBook, close_interrupted
from service.qa.desk import QaDesk
from service.qa.ports import QaRig
from service.qa.under_way import UnderWay
from service.readiness import ReadinessProbe
from service.room import Room
from service.runner import SessionRunner
from service.sessions import SessionBook
from service.settings import Settings
from service.tallies import Tallies
from service.ws.live import LiveStream

MODELS_FOLDER = "models"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _House:
    """Everything that was opened, and has to be closed."""

    services: Services
    runner: SessionRunner
    qa_desk: QaDesk
    log: AuditLog
    database: Database
    care: AuditCare
    room: Room

    def hold_and_close_session(self) -> None:
        """Let nothing begin any more, hold the beam, whoever has it, and end what goes on."""
        self.room.close()
        try:
            self.runner.shut_down()
        finally:
            self.qa_desk.shut_down()

    def close(self) -> None:
        """Hold the beam first, then write down and close."""
        self.hold_and_close_session()
        try:
            self.log.write(Event(actor=SYSTEM, action="service.stop"))
        finally:
            self.care.close()
            self.database.close()


def make_lifespan(
    settings: Settings, make_engine: Callable[[Settings], EnginePort], make_rig: Callable[[Settings], QaRig]
) -> Callable[[FastAPI], AbstractAsyncContextManager[None]]:
    """Make the application's lifespan."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        house = await anyio.to_thread.run_sync(_open, settings, make_engine(settings), make_rig(settings))
        app.state.services = house.services
        app.state.hold_and_close_session = house.hold_and_close_session
        app.state.live = LiveStream(max_clients=settings.max_live_clients, allowed_origins=settings.allowed_origins)
        try:
            yield
        finally:
            with anyio.CancelScope(shield=True):
                await anyio.to_thread.run_sync(house.close)

    return lifespan


def _open(settings: Settings, engine: EnginePort, rig: QaRig) -> _House:
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    database = Database(settings.database_place)
    database.migrate()
    log, room, tallies = AuditLog(database), Room(), Tallies()
    care = AuditCare(database=database, settings=settings, write=log.write)
    models = ModelStore(settings.data_dir / MODELS_FOLDER)
    book = SessionBook(database, log, settings, room, engine)
    runner = SessionRunner(
        engine=engine,
        database=database,
        log=log,
        book=book,
        models=models,
        room=room,
        settings=settings,
        tallies=tallies,
    )
    under_way = UnderWay()
    qa_desk = QaDesk(database=database, log=log, settings=settings, room=room, rig=rig, under_way=under_way)
    qa_book = QaBook(database, log, settings, under_way)
    services = Services(
        sessions=book,
        runner=runner,
        calibrations=CalibrationShelf(database, log),
        models=ModelShelf(database, room),
        audit=log,
        health=ReadinessProbe(database, settings, lambda: care.troubles),
        interlocks=InterlockTable(settings),
        metrics=Metrics(tallies, room),
        engine=engine,
        qa_desk=qa_desk,
        qa_book=qa_book,
    )
    care.start(_start_detail(engine))
    book.close_interrupted()
    close_interrupted(database)
    return _House(care=care, services=services, runner=runner, qa_desk=qa_desk, log=log, database=database, room=room)


def _start_detail(engine: EnginePort) -> dict[str, object]:
    return {"version": __version__, "is_simulated_beam": engine.is_simulated_beam}
