"""Builds the readiness probe and the metrics of the service."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import datetime

from prometheus_client.registry import Collector

from service.access.armed_operator import ArmedOperator
from service.access.service import AccessService
from service.core.settings.settings import Settings
from service.engine_host.equipment import EquipmentSlot
from service.engine_host.protocols import EnginePort
from service.exchange.pacs import PacsSender
from service.monitoring.certificate import ServedCertificate
from service.monitoring.machine import MachineDescription
from service.monitoring.metrics.engine import EngineMetrics
from service.monitoring.metrics.machine import DatabaseFigures, MachineMetrics
from service.monitoring.metrics.registry import HttpCounters, Metrics
from service.monitoring.readiness import ReadinessProbe
from service.sessions.alarms.watch import AlarmWatch
from service.sessions.lifecycle.counters import SessionCounters
from service.storage.audit.supervision import AuditSupervision
from service.storage.believed_time import BelievedTime
from service.storage.database import queries
from service.storage.database.engine import Database
from service.storage.files.cleanup import CleanupWorker


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MonitoredServices:
    """Services that readiness and metrics read."""

    settings: Settings
    database: Database
    equipment: EquipmentSlot
    engine: EnginePort
    counters: SessionCounters
    audit_supervision: AuditSupervision
    cleanup: CleanupWorker
    believed_time: BelievedTime
    access: AccessService
    armed_operator: ArmedOperator
    alarms: AlarmWatch
    certificate: ServedCertificate | None = None
    pacs: PacsSender | None = None

    def ended_threads(self) -> list[str]:
        """Return the names of threads that ended unexpectedly."""
        checked = {
            "armed-operator": self.armed_operator.has_ended,
            "access-cleanup": self.access.cleanup_worker.has_ended,
            "tidegate-cleanup": self.cleanup.has_ended,
            "tidegate-alarms": self.alarms.has_ended,
        }
        if self.pacs is not None:
            checked["tidegate-pacs"] = self.pacs.has_ended
        if self.certificate is not None:
            checked["tidegate-certificate"] = self.certificate.has_ended
        return [name for name, has_ended in checked.items() if has_ended]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Monitoring:
    """Readiness and metrics of the service."""

    health: ReadinessProbe
    machine: MachineDescription
    metrics: Metrics
    http: HttpCounters


def make_monitoring(services: MonitoredServices, others: Iterable[Collector] = ()) -> Monitoring:
    """Build readiness and metrics; ``others`` are additional collectors."""
    health = ReadinessProbe(
        services.database,
        services.settings,
        lambda: services.audit_supervision.troubles,
        ended_threads=services.ended_threads,
        engine_trouble=_trouble_of(services.engine),
        is_stopping=lambda: services.equipment.is_closed,
        certificate=services.certificate,
        time=services.believed_time,
    )
    collector = MachineMetrics(
        data_dir=services.settings.data_dir,
        figures=DatabaseFigures(services.database),
        certificate=services.certificate,
        access=services.access,
        readiness=health.readiness,
        room=services.settings.room,
        forwarded_rows=lambda: services.audit_supervision.passed_on,
    )
    collectors = (EngineMetrics(services.equipment, services.engine), collector, *others)
    registry = services.counters.registry
    machine = MachineDescription(
        settings=services.settings,
        readiness=health.readiness,
        backup_at=lambda: _newest_backup(services.database),
        certificate=services.certificate,
    )
    return Monitoring(
        health=health, machine=machine, metrics=Metrics(registry, collectors), http=HttpCounters(registry)
    )


def _newest_backup(database: Database) -> datetime | None:
    """Return when a backup was last recorded in the audit."""
    with database.read() as db:
        row = queries.newest_done(db, None, ["backup.made"])
        return None if row is None else datetime.fromisoformat(row.at)


def _trouble_of(engine: EnginePort) -> Callable[[], str | None]:
    """Return a function that gives the engine host's fault, None if it has none or reports none."""
    return lambda: getattr(engine, "trouble", None)
