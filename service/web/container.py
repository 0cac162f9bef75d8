"""Everything the service consists of: opened step by step at the start, closed with the beam held first."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field

from engine import __version__
from engine.capture import SourceDescription
from engine.core.compiled import frame_path
from service.access.accounts.people import OnFirstAdmin, make_first_admin
from service.access.armed_operator import ArmedOperator
from service.access.oidc.service import OidcService
from service.access.service import AccessService, open_access
from service.core.settings.settings import Settings
from service.engine_host.equipment import EquipmentSlot
from service.engine_host.plug_ins import described, use_plug_ins
from service.engine_host.protocols import EnginePort
from service.exchange.outbox import Outbox
from service.exchange.pacs import PacsSender, pacs_of
from service.monitoring.certificate import ServedCertificate
from service.monitoring.monitoring import MonitoredServices, Monitoring, make_monitoring
from service.planning.rt_plan.planned_sessions import PlannedSessions
from service.planning.rt_plan.repository import PlanRepository
from service.qa.archive import QaArchive, close_interrupted as close_interrupted_qa
from service.qa.arming_requirement import refuse_without_qa
from service.qa.jobs import CurrentRun, QaRig
from service.qa.latency.requirement import counted_latency_ms, refuse_unmeasured
from service.qa.runs import QaRunService
from service.sessions.alarms.watch import AlarmWatch, SiteTroubles
from service.sessions.coaching.board import CoachingBoard
from service.sessions.lifecycle.counters import SessionCounters
from service.sessions.lifecycle.runner import SessionRunner
from service.sessions.lifecycle.start import SessionStarter, writer_connections
from service.sessions.records.arming import ArmingSummaries
from service.sessions.records.calibrations import CalibrationRepository, ModelRepository, RecordingList
from service.sessions.records.etags import SessionRevisions
from service.sessions.records.sessions import SessionRepository
from service.sessions.recovery.interrupted import close_interrupted
from service.sessions.recovery.journal import recover_transitions
from service.sessions.report.exports import SessionExports
from service.sessions.report.reports import report_service
from service.sessions.report.simulations import SimulationDays
from service.sessions.report.trace import SessionTraces
from service.sessions.views.interlocks import InterlockTable
from service.storage.audit import SYSTEM, Event
from service.storage.audit.anchors import AnchorFile
from service.storage.audit.log import AuditLog
from service.storage.audit.service import AuditService
from service.storage.audit.supervision import AuditSupervision
from service.storage.believed_time import BelievedTime
from service.storage.database.engine import Database
from service.storage.database.startup import SAMPLES_FOLDER, prepare
from service.storage.files.cleanup import CleanupWorker
from service.storage.files.journals import Journals
from service.storage.files.motion_models import MODELS_FOLDER, ModelStore
from service.storage.samples.service import SampleService
from service.storage.samples.store import SampleStore
from service.web.dependencies import Services


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Dependencies:
    """What the container needs before it opens anything: settings, engine, QA rig, and the shared equipment slot."""

    settings: Settings
    engine: EnginePort
    rig: QaRig
    tell_first: OnFirstAdmin | None
    certificate: ServedCertificate | None = None
    equipment: EquipmentSlot = field(default_factory=EquipmentSlot)
    counters: SessionCounters = field(default_factory=SessionCounters)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Storage:
    """What is stored, and the workers that maintain it."""

    database: Database
    log: AuditLog
    samples: SampleStore
    journals: Journals
    alarms: AlarmWatch
    audit_supervision: AuditSupervision
    cleanup: CleanupWorker
    believed_time: BelievedTime
    exports: SessionExports
    outbox: Outbox
    pacs: PacsSender | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Work:
    """Sessions and QA runs, which use the equipment one at a time, with their records."""

    sessions: SessionRepository
    runner: SessionRunner
    arming: ArmingSummaries
    qa_runs: QaRunService
    qa_archive: QaArchive


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Access:
    """Who may do what, and the check that the operator who armed is still logged in."""

    service: AccessService
    oidc: OidcService
    armed_operator: ArmedOperator


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Container:
    """Everything that was opened and has to be closed; :meth:`close` holds the beam first."""

    services: Services
    equipment: EquipmentSlot
    storage: _Storage
    work: _Work
    access: _Access
    monitoring: Monitoring
    certificate: ServedCertificate | None

    def hold_and_close_session(self) -> None:
        """Refuse new sessions and QA runs, hold the beam, and end the one that runs."""
        self.equipment.close()
        try:
            self.work.runner.shut_down()
        finally:
            self.work.qa_runs.shut_down()

    def close(self) -> None:
        """Hold the beam, stop the workers, audit the stop, and close the database."""
        self.hold_and_close_session()
        self.services.engine.close()
        self.access.armed_operator.close()
        self.storage.alarms.close()
        self.storage.cleanup.close()
        if self.storage.pacs is not None:
            self.storage.pacs.close()
        if self.certificate is not None:
            self.certificate.close()
        self.access.oidc.close()
        self.access.service.close()
        try:
            self.storage.log.write(Event(actor=SYSTEM, action="service.stop"))
        finally:
            self.storage.audit_supervision.close()
            self.storage.database.close()


def open_container(
    settings: Settings,
    engine: EnginePort,
    rig: QaRig,
    tell_first: OnFirstAdmin | None,
    certificate: ServedCertificate | None = None,
) -> Container:
    """Open everything and start the workers; a start that fails leaves nothing open, the engine included."""
    dependencies = _Dependencies(
        settings=settings, engine=engine, rig=rig, tell_first=tell_first, certificate=certificate
    )
    with ExitStack() as on_failure:
        on_failure.callback(engine.close)
        storage = _open_storage(dependencies, on_failure)
        work = _open_work(dependencies, storage)
        access = _open_access(dependencies, storage, work, on_failure)
        monitoring = _open_monitoring(dependencies, storage, access)
        services = _services(dependencies, storage, work, monitoring)
        _begin(dependencies, storage, access, on_failure)
        on_failure.pop_all()
    return Container(
        services=services,
        equipment=dependencies.equipment,
        storage=storage,
        work=work,
        access=access,
        monitoring=monitoring,
        certificate=certificate,
    )


def _open_storage(dependencies: _Dependencies, on_failure: ExitStack) -> _Storage:
    settings, equipment = dependencies.settings, dependencies.equipment
    settings.data_dir.mkdir(parents=True, exist_ok=True, mode=0o700)
    database = Database(settings.database_place)
    on_failure.callback(database.close)
    database.claim()
    prepare(database, data_dir=settings.data_dir, min_free_disk_mb=settings.min_free_disk_mb)
    believed_time = BelievedTime(database)
    believed_time.start()
    log, samples = AuditLog(database), SampleStore(settings.data_dir / SAMPLES_FOLDER)
    audit_supervision = AuditSupervision(database=database, settings=settings, write=log.write)
    on_failure.callback(audit_supervision.close)
    outbox = Outbox(settings.data_dir, pacs=settings.pacs, takes_signed=settings.pacs_takes_signed)
    exports = SessionExports(database, samples, report_service(database, samples, settings))
    return _Storage(
        database=database,
        log=log,
        samples=samples,
        journals=Journals(settings.data_dir, settings.journal_dir),
        alarms=AlarmWatch(equipment, database),
        audit_supervision=audit_supervision,
        cleanup=CleanupWorker(database, settings, is_busy=lambda: equipment.running is not None, time=believed_time),
        believed_time=believed_time,
        exports=exports,
        outbox=outbox,
        pacs=_sender(settings, outbox, exports, log, is_busy=lambda: equipment.running is not None),
    )


def _sender(
    settings: Settings, outbox: Outbox, exports: SessionExports, log: AuditLog, *, is_busy: Callable[[], bool]
) -> PacsSender | None:
    if not settings.pacs:
        return None
    pacs = pacs_of(settings.pacs, settings.pacs_ca, settings.pacs_commit_port)
    return PacsSender(pacs, outbox, lambda one: [exports.waveform(one), exports.report(one)], log, is_busy=is_busy)


def _open_work(dependencies: _Dependencies, storage: _Storage) -> _Work:
    settings, engine, equipment = dependencies.settings, dependencies.engine, dependencies.equipment
    database, log, current_run = storage.database, storage.log, CurrentRun()
    records = SessionRepository(database, log, settings, equipment, engine, storage.cleanup.tidy, storage.alarms.board)
    starter = SessionStarter(
        engine=engine,
        database=database,
        writer_database=writer_connections(database),
        models=ModelStore(settings.data_dir / MODELS_FOLDER),
        equipment=equipment,
        settings=settings,
        counters=dependencies.counters,
        samples=storage.samples,
        journals=storage.journals,
        alarms=storage.alarms,
        camera_latency_ms=lambda db, serial: counted_latency_ms(db, settings, serial),
    )

    def refuse_arming(camera: SourceDescription | None) -> None:
        refuse_without_qa(database, settings)
        refuse_unmeasured(database, settings, camera)

    runner = SessionRunner(
        starter=starter,
        log=log,
        records=records,
        refuse_arming=refuse_arming,
    )
    return _Work(
        sessions=records,
        runner=runner,
        arming=ArmingSummaries(
            sessions=records,
            models=ModelRepository(database, equipment, ModelStore(settings.data_dir / MODELS_FOLDER)),
            database=database,
            equipment=equipment,
            settings=settings,
            refuse_arming=refuse_arming,
        ),
        qa_runs=QaRunService(
            database=database,
            log=log,
            settings=settings,
            equipment=equipment,
            rig=dependencies.rig,
            current_run=current_run,
        ),
        qa_archive=QaArchive(database, log, settings, current_run),
    )


def _open_access(dependencies: _Dependencies, storage: _Storage, work: _Work, on_failure: ExitStack) -> _Access:
    service = open_access(storage.database, storage.log, dependencies.settings, room=dependencies.settings.room)
    on_failure.callback(service.close)
    if dependencies.tell_first is not None:
        make_first_admin(service.store, service.accounts, dependencies.tell_first)
    oidc = OidcService(dependencies.settings, service, dependencies.counters.registry)
    oidc.start()
    on_failure.callback(oidc.close)
    armed_operator = ArmedOperator(
        is_present=service.authenticator.is_present,
        armed=dependencies.equipment.armed,
        hold=work.runner.commands.hold_unattended,
    )
    return _Access(service=service, oidc=oidc, armed_operator=armed_operator)


def _open_monitoring(dependencies: _Dependencies, storage: _Storage, access: _Access) -> Monitoring:
    monitored = MonitoredServices(
        settings=dependencies.settings,
        database=storage.database,
        equipment=dependencies.equipment,
        engine=dependencies.engine,
        counters=dependencies.counters,
        audit_supervision=storage.audit_supervision,
        cleanup=storage.cleanup,
        believed_time=storage.believed_time,
        access=access.service,
        armed_operator=access.armed_operator,
        alarms=storage.alarms,
        certificate=dependencies.certificate,
        pacs=storage.pacs,
    )
    storage.alarms.troubles = SiteTroubles(
        audit=lambda: storage.audit_supervision.troubles, ended_threads=monitored.ended_threads
    )
    return make_monitoring(monitored)


def _services(dependencies: _Dependencies, storage: _Storage, work: _Work, monitoring: Monitoring) -> Services:
    settings, database, log = dependencies.settings, storage.database, storage.log
    reports = report_service(database, storage.samples, settings)
    return Services(
        sessions=work.sessions,
        runner=work.runner,
        arming=work.arming,
        samples=SampleService(database, storage.samples),
        reports=reports,
        exports=storage.exports,
        simulations=SimulationDays(database, storage.exports, log),
        outbox=storage.outbox,
        traces=SessionTraces(database, storage.samples, ModelStore(settings.data_dir / MODELS_FOLDER)),
        calibrations=CalibrationRepository(database, log),
        recordings=RecordingList(settings.recording_folders),
        models=ModelRepository(database, dependencies.equipment, ModelStore(settings.data_dir / MODELS_FOLDER)),
        plans=PlanRepository(database, log, settings),
        planned_sessions=PlannedSessions(database, log, work.sessions, settings.gantry_side),
        audit=AuditService(database, log, AnchorFile(settings.anchor_file)),
        health=monitoring.health,
        machine=monitoring.machine,
        interlocks=InterlockTable(settings),
        metrics=monitoring.metrics,
        engine=dependencies.engine,
        qa_runs=work.qa_runs,
        qa_archive=work.qa_archive,
        revisions=SessionRevisions(database, work.runner.withdrawals),
        alarms=storage.alarms.board,
        coaching=CoachingBoard(running=work.runner.running, log=log),
    )


def _begin(dependencies: _Dependencies, storage: _Storage, access: _Access, on_failure: ExitStack) -> None:
    """Start the workers, and record what the last run of the service could not."""
    access.armed_operator.start()
    on_failure.callback(access.armed_operator.close)
    storage.audit_supervision.start(_start_detail(dependencies, storage.journals))
    recover_transitions(storage.database, storage.journals)
    close_interrupted(storage.database, storage.samples)
    close_interrupted_qa(storage.database)
    storage.cleanup.start()
    if storage.pacs is not None:
        storage.pacs.start()
        on_failure.callback(storage.pacs.close)
    storage.alarms.start()
    on_failure.callback(storage.alarms.close)
    if dependencies.certificate is not None:
        dependencies.certificate.start()
        on_failure.callback(dependencies.certificate.close)


def _start_detail(dependencies: _Dependencies, journals: Journals) -> dict[str, object]:
    return {
        "version": __version__,
        "frame_path": frame_path(),
        "mode": dependencies.settings.mode,
        "is_simulated_beam": dependencies.engine.is_simulated_beam,
        "hardware_dead_man": dependencies.settings.hardware_dead_man,
        "journal_folder": str(journals.folder),
        "plug_ins": list(map(described, use_plug_ins(dependencies.settings))),
    }
