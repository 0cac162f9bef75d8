"""What happens at start and at the end; on the way out the beam is held before anything is closed."""

from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, ExitStack, asynccontextmanager
from dataclasses import dataclass

import anyio
import anyio.to_thread
from fastapi import FastAPI
from sqlalchemy.exc import SQLAlchemyError

from engine import __version__
from engine.errors import TidegateError
from service.access.attendance import Attendance
from service.access.desk import AccessDesk, open_access
from service.access.first import TellFirst, make_first_admin
from service.access.oidc_desk import OidcDesk
from service.audit import SYSTEM, Event
from service.audit.anchors import AnchorFile
from service.audit.care import AuditCare
from service.audit_desk import AuditDesk
from service.audit_log import AuditLog
from service.calibrations import CalibrationShelf
from service.caretaker import Caretaker
from service.db.engine import Database
from service.db.preparing import SAMPLES_FOLDER, prepare
from service.deps import Services
from service.interlocks import InterlockTable
from service.interrupted import close_interrupted
from service.journal_recovery import recover_transitions
from service.journals import Journals
from service.model_store import MODELS_FOLDER, ModelStore
from service.motion_models import ModelShelf
from service.plans.preparing import PlannedSessions
from service.plans.shelf import PlanShelf
from service.ports import EnginePort
from service.qa.book import QaBook
from service.qa.book import close_interrupted as close_interrupted_qa
from service.qa.desk import QaDesk
from service.qa.ports import QaRig
from service.qa.under_way import UnderWay
from service.revisions import SessionRevisions
from service.room import Room
from service.runner import SessionRunner
from service.samples.desk import SampleDesk
from service.samples.register import adopt
from service.samples.shelf import SampleShelf
from service.samples.tail import SampleTails
from service.sessions import SessionBook
from service.settings import Settings
from service.stream.hub import LiveHub
from service.stream.resuming import Resumption
from service.stream_metrics import StreamMetrics
from service.tallies import Tallies
from service.watching import Watched, Watching, make_watching


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _House:
    """Everything that was opened, and has to be closed."""

    services: Services
    runner: SessionRunner
    qa_desk: QaDesk
    log: AuditLog
    database: Database
    care: AuditCare
    caretaker: Caretaker
    room: Room
    access: AccessDesk
    oidc: OidcDesk
    attendance: Attendance
    watching: Watching

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
        self.services.engine.close()
        self.attendance.close()
        self.caretaker.close()
        self.oidc.close()
        self.access.close()
        try:
            self.log.write(Event(actor=SYSTEM, action="service.stop"))
        finally:
            self.care.close()
            self.database.close()


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
                _open, settings, make_engine(settings), make_rig(settings), tell_first
            )
        except (TidegateError, SQLAlchemyError) as error:
            app.state.start_refusal = _refusal(error)
            raise
        app.state.services = house.services
        app.state.http_tallies = house.watching.http
        app.state.access = house.access
        app.state.oidc = house.oidc
        app.state.attendance = house.attendance
        app.state.hold_and_close_session = house.hold_and_close_session
        app.state.live = LiveHub(
            house.services.runner, max_clients=settings.max_live_clients, stall_s=settings.live_stall_s
        )
        house.watching.metrics.add(StreamMetrics(app.state.live.reading))
        tails = SampleTails(SampleShelf(settings.data_dir / SAMPLES_FOLDER))
        app.state.resumption = Resumption(tails, longest_s=settings.live_resume_s)
        try:
            yield
        finally:
            with anyio.CancelScope(shield=True):
                # A thread of its own: calls that hang in all the others keep the house from being closed by none.
                await anyio.to_thread.run_sync(house.close, limiter=anyio.CapacityLimiter(1))

    return lifespan


def _open(settings: Settings, engine: EnginePort, rig: QaRig, tell_first: TellFirst | None) -> _House:
    settings.data_dir.mkdir(parents=True, exist_ok=True, mode=0o700)
    database = Database(settings.database_place)
    shelf = SampleShelf(settings.data_dir / SAMPLES_FOLDER)
    database.claim()
    prepare(database, data_dir=settings.data_dir, min_free_disk_mb=settings.min_free_disk_mb)
    log, room, tallies = AuditLog(database), Room(), Tallies()
    journals = Journals(settings.data_dir, settings.journal_dir)
    care = AuditCare(database=database, settings=settings, write=log.write, site=settings.site_name)
    models = ModelStore(settings.data_dir / MODELS_FOLDER)
    caretaker = Caretaker(
        database, settings, is_busy=lambda: room.running is not None, first=lambda: adopt(database, shelf)
    )
    book = SessionBook(database, log, settings, room, engine, caretaker.tidy)
    runner = SessionRunner(
        engine=engine,
        database=database,
        log=log,
        book=book,
        models=models,
        room=room,
        settings=settings,
        tallies=tallies,
        shelf=shelf,
        journals=journals,
    )
    under_way = UnderWay()
    qa_desk = QaDesk(database=database, log=log, settings=settings, room=room, rig=rig, under_way=under_way)
    qa_book = QaBook(database, log, settings, under_way)
    access = open_access(database, log, settings)
    if tell_first is not None:
        make_first_admin(access.store, access.people, tell_first)
    oidc = OidcDesk(settings, access, tallies.registry)
    oidc.start()
    attendance = Attendance(
        is_here=access.doorkeeper.is_here,
        is_armed=room.is_armed,
        hold=runner.hold_unattended,
    )
    watching = make_watching(
        Watched(
            settings=settings,
            database=database,
            room=room,
            engine=engine,
            tallies=tallies,
            care=care,
            caretaker=caretaker,
            access=access,
            attendance=attendance,
        )
    )
    services = Services(
        sessions=book,
        runner=runner,
        samples=SampleDesk(database, shelf),
        calibrations=CalibrationShelf(database, log),
        models=ModelShelf(database, room),
        plans=PlanShelf(database, log, settings),
        planned_sessions=PlannedSessions(database, log, book),
        audit=AuditDesk(database, log, AnchorFile(settings.anchor_file), site=settings.site_name),
        health=watching.health,
        interlocks=InterlockTable(settings),
        metrics=watching.metrics,
        engine=engine,
        qa_desk=qa_desk,
        qa_book=qa_book,
        revisions=SessionRevisions(database),
    )
    attendance.start()
    care.start({**_start_detail(engine), "journal_folder": str(journals.folder)})
    with ExitStack() as undone:  # a start that is refused leaves nothing open
        for close in (database.close, care.close, engine.close, attendance.close):
            undone.callback(close)
        recover_transitions(database, journals)
        undone.pop_all()
    close_interrupted(database, shelf)
    close_interrupted_qa(database)
    caretaker.start()
    return _House(
        care=care,
        caretaker=caretaker,
        services=services,
        runner=runner,
        qa_desk=qa_desk,
        log=log,
        database=database,
        room=room,
        access=access,
        oidc=oidc,
        attendance=attendance,
        watching=watching,
    )


def _refusal(error: TidegateError | SQLAlchemyError) -> str:
    """Say why nothing was started; what a driver says may hold more than a log should."""
    if isinstance(error, SQLAlchemyError):
        return f"the database does not answer, or not as it should ({type(error).__name__})"
    return str(error)


def _start_detail(engine: EnginePort) -> dict[str, object]:
    return {"version": __version__, "is_simulated_beam": engine.is_simulated_beam}
