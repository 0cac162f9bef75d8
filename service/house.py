"""Everything the service is made of: opened step by step at the start, closed with the beam held first."""

from contextlib import ExitStack
from dataclasses import dataclass, field

from engine import __version__
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
from service.sessions import SessionBook
from service.settings import Settings
from service.tallies import Tallies
from service.watching import Watched, Watching, make_watching


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Brought:
    """What the house is opened with."""

    settings: Settings
    engine: EnginePort
    rig: QaRig
    tell_first: TellFirst | None
    room: Room = field(default_factory=Room)
    tallies: Tallies = field(default_factory=Tallies)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Storage:
    """What outlives the service, and who looks after it."""

    database: Database
    log: AuditLog
    shelf: SampleShelf
    journals: Journals
    care: AuditCare
    caretaker: Caretaker


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Work:
    """What may have the beam, one at a time, and what is written of it."""

    book: SessionBook
    runner: SessionRunner
    qa_desk: QaDesk
    qa_book: QaBook


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _People:
    """Who may come in, and whether whoever armed is still there."""

    access: AccessDesk
    oidc: OidcDesk
    attendance: Attendance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class House:
    """Everything that was opened, and has to be closed."""

    services: Services
    room: Room
    storage: _Storage
    work: _Work
    people: _People
    watching: Watching

    def hold_and_close_session(self) -> None:
        """Let nothing begin any more, hold the beam, whoever has it, and end what goes on."""
        self.room.close()
        try:
            self.work.runner.shut_down()
        finally:
            self.work.qa_desk.shut_down()

    def close(self) -> None:
        """Hold the beam first, then write down and close."""
        self.hold_and_close_session()
        self.services.engine.close()
        self.people.attendance.close()
        self.storage.caretaker.close()
        self.people.oidc.close()
        self.people.access.close()
        try:
            self.storage.log.write(Event(actor=SYSTEM, action="service.stop"))
        finally:
            self.storage.care.close()
            self.storage.database.close()


def open_house(settings: Settings, engine: EnginePort, rig: QaRig, tell_first: TellFirst | None) -> House:
    """Open everything, and begin; a start that is refused leaves nothing open, the engine included."""
    brought = _Brought(settings=settings, engine=engine, rig=rig, tell_first=tell_first)
    with ExitStack() as undone:
        undone.callback(engine.close)
        storage = _open_storage(brought, undone)
        work = _lay_out_work(brought, storage)
        people = _open_people(brought, storage, work, undone)
        watching = _watch(brought, storage, people)
        services = _services(brought, storage, work, watching)
        _begin(brought, storage, people, undone)
        undone.pop_all()
    return House(services=services, room=brought.room, storage=storage, work=work, people=people, watching=watching)


def _open_storage(brought: _Brought, undone: ExitStack) -> _Storage:
    settings, room = brought.settings, brought.room
    settings.data_dir.mkdir(parents=True, exist_ok=True, mode=0o700)
    database = Database(settings.database_place)
    undone.callback(database.close)
    database.claim()
    prepare(database, data_dir=settings.data_dir, min_free_disk_mb=settings.min_free_disk_mb)
    log, shelf = AuditLog(database), SampleShelf(settings.data_dir / SAMPLES_FOLDER)
    care = AuditCare(database=database, settings=settings, write=log.write, site=settings.site_name)
    undone.callback(care.close)
    return _Storage(
        database=database,
        log=log,
        shelf=shelf,
        journals=Journals(settings.data_dir, settings.journal_dir),
        care=care,
        caretaker=Caretaker(
            database, settings, is_busy=lambda: room.running is not None, first=lambda: adopt(database, shelf)
        ),
    )


def _lay_out_work(brought: _Brought, storage: _Storage) -> _Work:
    settings, engine, room = brought.settings, brought.engine, brought.room
    database, log, under_way = storage.database, storage.log, UnderWay()
    book = SessionBook(database, log, settings, room, engine, storage.caretaker.tidy)
    runner = SessionRunner(
        engine=engine,
        database=database,
        log=log,
        book=book,
        models=ModelStore(settings.data_dir / MODELS_FOLDER),
        room=room,
        settings=settings,
        tallies=brought.tallies,
        shelf=storage.shelf,
        journals=storage.journals,
    )
    return _Work(
        book=book,
        runner=runner,
        qa_desk=QaDesk(database=database, log=log, settings=settings, room=room, rig=brought.rig, under_way=under_way),
        qa_book=QaBook(database, log, settings, under_way),
    )


def _open_people(brought: _Brought, storage: _Storage, work: _Work, undone: ExitStack) -> _People:
    access = open_access(storage.database, storage.log, brought.settings)
    undone.callback(access.close)
    if brought.tell_first is not None:
        make_first_admin(access.store, access.people, brought.tell_first)
    oidc = OidcDesk(brought.settings, access, brought.tallies.registry)
    oidc.start()
    undone.callback(oidc.close)
    attendance = Attendance(
        is_here=access.doorkeeper.is_here, is_armed=brought.room.is_armed, hold=work.runner.hold_unattended
    )
    return _People(access=access, oidc=oidc, attendance=attendance)


def _watch(brought: _Brought, storage: _Storage, people: _People) -> Watching:
    return make_watching(
        Watched(
            settings=brought.settings,
            database=storage.database,
            room=brought.room,
            engine=brought.engine,
            tallies=brought.tallies,
            care=storage.care,
            caretaker=storage.caretaker,
            access=people.access,
            attendance=people.attendance,
        )
    )


def _services(brought: _Brought, storage: _Storage, work: _Work, watching: Watching) -> Services:
    settings, database, log = brought.settings, storage.database, storage.log
    return Services(
        sessions=work.book,
        runner=work.runner,
        samples=SampleDesk(database, storage.shelf),
        calibrations=CalibrationShelf(database, log),
        models=ModelShelf(database, brought.room),
        plans=PlanShelf(database, log, settings),
        planned_sessions=PlannedSessions(database, log, work.book),
        audit=AuditDesk(database, log, AnchorFile(settings.anchor_file), site=settings.site_name),
        health=watching.health,
        interlocks=InterlockTable(settings),
        metrics=watching.metrics,
        engine=brought.engine,
        qa_desk=work.qa_desk,
        qa_book=work.qa_book,
        revisions=SessionRevisions(database, work.runner.withdrawals),
    )


def _begin(brought: _Brought, storage: _Storage, people: _People, undone: ExitStack) -> None:
    """Set the threads to work, and write down what the last run of the service could not."""
    people.attendance.start()
    undone.callback(people.attendance.close)
    storage.care.start({**_start_detail(brought.engine), "journal_folder": str(storage.journals.folder)})
    recover_transitions(storage.database, storage.journals)
    close_interrupted(storage.database, storage.shelf)
    close_interrupted_qa(storage.database)
    storage.caretaker.start()


def _start_detail(engine: EnginePort) -> dict[str, object]:
    return {"version": __version__, "is_simulated_beam": engine.is_simulated_beam}
