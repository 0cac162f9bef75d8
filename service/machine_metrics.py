"""What a monitoring system reads about the machine and the service around the gate; read when asked."""

import platform
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.registry import Collector
from sqlalchemy import text
from sqlalchemy.exc import SQLAlchemyError

from engine import __version__
from engine.clock import NS_PER_S, Clock, MonotonicClock
from service.access import lockout
from service.access.desk import AccessDesk
from service.audit.walk import head_sequence
from service.certificate import CertificateWatch
from service.db.engine import Database
from service.readiness_schemas import Readiness, ReadinessCode
from service.unhurried_log import dropped_lines

FIGURES_KEPT_S = 5.0
WHY = {
    "not logged in": "not_logged_in",
    "foreign pages": "foreign_page",
    "locked out": "locked_out",
    "failed log-ins of unknown names": "unknown_name",
    "user.login": "failed_login",
    "access.refused": "permission_missing",
}
"""What refusals are counted as, by the ledger's words."""
OTHER = "other"


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredFigures:
    """How much is stored; None where the database did not say."""

    database_bytes: int
    audit_rows: int


class DatabaseFigures:
    """Asks the database how large it is, now and then: scrapes must neither load one nor hang with one that hangs."""

    def __init__(self, database: Database, clock: Clock | None = None) -> None:
        self._database = database
        self._clock = clock or MonotonicClock()
        self._asking = threading.Lock()
        self._kept: tuple[int, StoredFigures | None] | None = None

    def read(self) -> StoredFigures | None:
        """Return the newest answer; None where there is none."""
        kept = self._kept
        if kept is not None and self._clock.now_ns() - kept[0] < FIGURES_KEPT_S * NS_PER_S:
            return kept[1]
        if not self._asking.acquire(blocking=False):
            return None
        try:
            self._kept = (self._clock.now_ns(), self._ask())
        finally:
            self._asking.release()
        return self._kept[1]

    def _ask(self) -> StoredFigures | None:
        try:
            with self._database.read() as db:
                rows = head_sequence(db)
                if self._database.is_postgresql:
                    size = int(db.execute(text("SELECT pg_database_size(current_database())")).scalar_one())
                else:
                    size = _file_bytes(self._database.path)
        except (SQLAlchemyError, OSError):
            return None
        return StoredFigures(database_bytes=size, audit_rows=rows)


def _file_bytes(path: Path) -> int:
    wal = path.with_name(f"{path.name}-wal")
    return path.stat().st_size + (wal.stat().st_size if wal.exists() else 0)


class MachineMetrics(Collector):
    """Disk, database, certificate, log-ins, log and readiness."""

    def __init__(
        self,
        *,
        data_dir: Path,
        figures: DatabaseFigures,
        certificate: CertificateWatch,
        access: AccessDesk,
        readiness: Callable[[], Readiness],
        passed_on: Callable[[], int | None] = lambda: None,
    ) -> None:
        self._data_dir = data_dir
        self._figures = figures
        self._certificate = certificate
        self._access = access
        self._readiness = readiness
        self._passed_on = passed_on

    def describe(self) -> list[Metric]:
        """Name nothing beforehand: a registry that asks would have everything looked at."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Look at everything; what is not known is left out, never zero."""
        yield InfoMetricFamily(
            "tidegate_build", "The software", {"version": __version__, "python": platform.python_version()}
        )
        yield _gauge("tidegate_threads", "Threads of the service's process", threading.active_count())
        yield CounterMetricFamily(
            "tidegate_log_lines_dropped", "Lines of the log that nobody took in time", value=dropped_lines()
        )
        yield from self._ready()
        yield from self._disk()
        yield from self._stored()
        yield from self._certificate_end()
        yield from self._people()

    def _ready(self) -> Iterator[Metric]:
        readiness = self._readiness()
        yield _gauge("tidegate_ready", "Whether a session could run", float(readiness.is_ready))
        reasons = {one.code for one in readiness.reasons}
        warnings = {one.code for one in readiness.warnings}
        missing = GaugeMetricFamily("tidegate_not_ready", "1 for what keeps sessions from running", labels=["code"])
        warned = GaugeMetricFamily("tidegate_readiness_warning", "1 for what keeps none from it yet", labels=["code"])
        for code in ReadinessCode:
            missing.add_metric([code.value], float(code in reasons))
            warned.add_metric([code.value], float(code in warnings))
        yield missing
        yield warned

    def _disk(self) -> Iterator[Metric]:
        try:
            usage = shutil.disk_usage(self._data_dir)
        except OSError:
            return
        yield _gauge("tidegate_disk_free_bytes", "Room left on the data folder's disk", usage.free)
        yield _gauge("tidegate_disk_size_bytes", "Size of the data folder's disk", usage.total)

    def _stored(self) -> Iterator[Metric]:
        figures = self._figures.read()
        if figures is None:
            return
        yield _gauge("tidegate_database_size_bytes", "Size of the database", figures.database_bytes)
        yield _gauge("tidegate_audit_rows", "Rows of the audit", figures.audit_rows)
        passed_on = self._passed_on()
        if passed_on is not None:
            waiting = max(figures.audit_rows - passed_on, 0)
            yield _gauge("tidegate_audit_waiting_rows", "Rows of the audit that were not passed on yet", waiting)

    def _certificate_end(self) -> Iterator[Metric]:
        try:
            ends_at = self._certificate.ends_at()
        except (OSError, ValueError):
            return  # told by the readiness
        if ends_at is not None:
            name = "tidegate_certificate_end_timestamp_seconds"
            yield _gauge(name, "When the TLS certificate ends", ends_at.timestamp())

    def _people(self) -> Iterator[Metric]:
        store = self._access.store
        yield _gauge("tidegate_logins_open", "Log-ins that are open", len(store.logins))
        now = store.now()
        locked = sum(lockout.wait_s(one, now) > 0 for one in list(store.attempts.values()))
        yield _gauge("tidegate_logins_locked", "Names and addresses that have to wait before they try again", locked)
        refused = CounterMetricFamily("tidegate_refused", "Calls and log-ins that were refused", labels=["why"])
        for why, count in _refusals(self._access.ledger.total).items():
            refused.add_metric([why], count)
        yield refused


def _refusals(total: Mapping[str, int]) -> dict[str, int]:
    """Add up by words of ours; others, however many there come to be, under one."""
    found = dict.fromkeys([*WHY.values(), OTHER], 0)
    for what, count in dict(total).items():
        found[WHY.get(what, OTHER)] += count
    return found


def _gauge(name: str, words: str, value: float) -> Metric:
    return GaugeMetricFamily(name, words, value=value)
