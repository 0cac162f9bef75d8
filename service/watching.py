"""Puts together what watches the service: the readiness and the metrics, over everything that was opened."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from prometheus_client.registry import Collector

from service.access.attendance import Attendance
from service.access.desk import AccessDesk
from service.audit.care import AuditCare
from service.caretaker import Caretaker
from service.certificate import CertificateWatch
from service.db.engine import Database
from service.engine_metrics import EngineMetrics
from service.http_tallies import HttpTallies
from service.machine_metrics import DatabaseFigures, MachineMetrics
from service.metrics import Metrics
from service.ports import EnginePort
from service.readiness import ReadinessProbe
from service.room import Room
from service.settings import Settings
from service.tallies import Tallies


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Watched:
    """Everything that is looked at."""

    settings: Settings
    database: Database
    room: Room
    engine: EnginePort
    tallies: Tallies
    care: AuditCare
    caretaker: Caretaker
    access: AccessDesk
    attendance: Attendance

    def ended_threads(self) -> list[str]:
        """Name the threads that ended although nobody said so."""
        looked_at = {
            "attendance": self.attendance.has_ended,
            "access-keeper": self.access.keeper.has_ended,
            "tidegate-caretaker": self.caretaker.has_ended,
        }
        return [name for name, has_ended in looked_at.items() if has_ended]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Watching:
    """What answers whoever watches."""

    health: ReadinessProbe
    metrics: Metrics
    http: HttpTallies


def make_watching(watched: Watched, others: Iterable[Collector] = ()) -> Watching:
    """Make readiness and metrics; ``others`` are collectors of parts that bring their own."""
    health = ReadinessProbe(
        watched.database,
        watched.settings,
        lambda: watched.care.troubles,
        ended_threads=watched.ended_threads,
        engine_trouble=_trouble_of(watched.engine),
        is_stopping=lambda: watched.room.is_closed,
    )
    machine = MachineMetrics(
        data_dir=watched.settings.data_dir,
        figures=DatabaseFigures(watched.database),
        certificate=CertificateWatch(watched.settings.tls_cert),
        access=watched.access,
        readiness=health.readiness,
        passed_on=lambda: watched.care.passed_on,
    )
    collectors = (EngineMetrics(watched.room, watched.engine), machine, *others)
    registry = watched.tallies.registry
    return Watching(health=health, metrics=Metrics(registry, collectors), http=HttpTallies(registry))


def _trouble_of(engine: EnginePort) -> Callable[[], str | None]:
    """Ask the engines' maker whether one could be made, where it can say."""
    return lambda: getattr(engine, "trouble", None)
