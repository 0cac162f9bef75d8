"""Metrics of disk, database, certificate, log-ins, log and readiness, read at every scrape."""

import platform
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.registry import Collector
from sqlalchemy import text
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from engine import __version__
from engine.core.clock import NS_PER_S, Clock, MonotonicClock
from engine.core.compiled import frame_path
from service.access.login import lockout
from service.access.service import AccessService
from service.core.logging.nonblocking import dropped_lines
from service.core.schemas.base import Readiness, ReadinessCode
from service.monitoring.certificate import ServedCertificate
from service.storage.audit.verification import head_sequence
from service.storage.database.engine import Database

SLOTS = text(
    "SELECT slot_name AS name, active AS is_active, wal_status IS NOT DISTINCT FROM 'lost' AS is_lost, "
    "CASE WHEN pg_is_in_recovery() THEN NULL "
    "ELSE pg_wal_lsn_diff(pg_current_wal_lsn(), confirmed_flush_lsn)::bigint END AS behind_bytes, "
    "pg_size_bytes(current_setting('max_slot_wal_keep_size')) AS limit_bytes "
    "FROM pg_replication_slots WHERE slot_type = 'logical' AND database = current_database() ORDER BY slot_name"
)
CACHE_S = 5.0
REFUSAL_LABELS = {
    "not logged in": "not_logged_in",
    "foreign pages": "foreign_page",
    "locked out": "locked_out",
    "failed log-ins of unknown names": "unknown_name",
    "user.login": "failed_login",
    "access.refused": "permission_missing",
}
"""Metric label of each kind of refused log-in or call."""
OTHER = "other"


# Metrics of the slots by which a department follows this room's PostgreSQL database; none for SQLite.
#
# The room reports them, because it is the room whose disk keeps what a department has not fetched.
@dataclass(frozen=True, slots=True, kw_only=True)
class ReplicationSlot:
    """How far one follower is; ``limit_bytes`` is negative where the room keeps log for it without a bound."""

    name: str
    is_active: bool
    is_lost: bool
    behind_bytes: int | None
    limit_bytes: int


def read_slots(db: Session) -> tuple[ReplicationSlot, ...]:
    """Read the slots of this PostgreSQL database; raise SQLAlchemyError if it does not answer."""
    return tuple(ReplicationSlot(**row) for row in db.execute(SLOTS).mappings())


def slot_metrics(slots: Sequence[ReplicationSlot]) -> Iterator[Metric]:
    """Return the metrics of all slots; an unknown value is omitted."""
    active = _family("active", "1 while a department follows this room's records")
    lost = _family("lost", "1 where a department has to copy all records again: it was away for too long")
    behind = _family("behind_bytes", "Log that a department has not confirmed")
    limit = _family("limit_bytes", "Log that the room keeps for a department at most; -1: without a bound")
    for slot in slots:
        active.add_metric([slot.name], float(slot.is_active))
        lost.add_metric([slot.name], float(slot.is_lost))
        limit.add_metric([slot.name], slot.limit_bytes)
        if slot.behind_bytes is not None:
            behind.add_metric([slot.name], slot.behind_bytes)
    yield from (active, lost, behind, limit)


def _family(name: str, description: str) -> GaugeMetricFamily:
    return GaugeMetricFamily(f"tidegate_replication_{name}", description, labels=["slot"])


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredFigures:
    """Number of stored rows; None if the database did not answer."""

    database_bytes: int
    audit_rows: int
    slots: tuple[ReplicationSlot, ...] = ()


class DatabaseFigures:
    """Reads size and audit rows of the database, cached for CACHE_S; never waits for a reading in progress."""

    def __init__(self, database: Database, clock: Clock | None = None) -> None:
        self._database = database
        self._clock = clock or MonotonicClock()
        self._reading = threading.Lock()
        self._cached: tuple[int, StoredFigures | None] | None = None

    def read(self) -> StoredFigures | None:
        """Return the newest figures; None if the database did not answer or is being read."""
        cached = self._cached
        if cached is not None and self._clock.now_ns() - cached[0] < CACHE_S * NS_PER_S:
            return cached[1]
        if not self._reading.acquire(blocking=False):
            return None
        try:
            self._cached = (self._clock.now_ns(), self._read())
        finally:
            self._reading.release()
        return self._cached[1]

    def _read(self) -> StoredFigures | None:
        try:
            with self._database.read() as db:
                rows = head_sequence(db)
                slots: tuple[ReplicationSlot, ...] = ()
                if self._database.is_postgresql:
                    size = int(db.execute(text("SELECT pg_database_size(current_database())")).scalar_one())
                    slots = read_slots(db)
                else:
                    size = _file_bytes(self._database.path)
        except (SQLAlchemyError, OSError):
            return None
        return StoredFigures(database_bytes=size, audit_rows=rows, slots=slots)


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
        certificate: ServedCertificate | None,
        access: AccessService,
        readiness: Callable[[], Readiness],
        room: str = "",
        forwarded_rows: Callable[[], int | None] = lambda: None,
    ) -> None:
        self._data_dir = data_dir
        self._figures = figures
        self._certificate = certificate
        self._access = access
        self._readiness = readiness
        self._room = room
        self._forwarded = forwarded_rows

    def describe(self) -> list[Metric]:
        """Return nothing, so that registration reads nothing."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Read all values; an unknown value is omitted, never reported as zero."""
        yield InfoMetricFamily(
            "tidegate_build",
            "Version of the software",
            {"version": __version__, "python": platform.python_version(), "frame_path": frame_path()},
        )
        if self._room:
            yield InfoMetricFamily("tidegate_room", "The room's name, TIDEGATE_ROOM", {"name": self._room})
        yield _gauge("tidegate_threads", "Threads of the service's process", threading.active_count())
        yield CounterMetricFamily(
            "tidegate_log_lines_dropped", "Log lines dropped because the output was too slow", value=dropped_lines()
        )
        yield from self._ready()
        yield from self._disk()
        yield from self._stored()
        yield from self._certificate_end()
        yield from self._logins()

    def _ready(self) -> Iterator[Metric]:
        readiness = self._readiness()
        yield _gauge("tidegate_ready", "1 if a session can run", float(readiness.is_ready))
        reasons = {one.code for one in readiness.reasons}
        warnings = {one.code for one in readiness.warnings}
        missing = GaugeMetricFamily("tidegate_not_ready", "1 for each reason that prevents sessions", labels=["code"])
        warned = GaugeMetricFamily(
            "tidegate_readiness_warning", "1 for each warning that does not prevent sessions", labels=["code"]
        )
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
        yield _gauge("tidegate_disk_free_bytes", "Free space on the data folder's disk", usage.free)
        yield _gauge("tidegate_disk_size_bytes", "Size of the data folder's disk", usage.total)

    def _stored(self) -> Iterator[Metric]:
        figures = self._figures.read()
        if figures is None:
            return
        yield _gauge("tidegate_database_size_bytes", "Size of the database", figures.database_bytes)
        yield _gauge("tidegate_audit_rows", "Rows of the audit log", figures.audit_rows)
        if figures.slots:
            yield from slot_metrics(figures.slots)
        forwarded = self._forwarded()
        if forwarded is not None:
            waiting = max(figures.audit_rows - forwarded, 0)
            yield _gauge("tidegate_audit_waiting_rows", "Audit rows not yet in the log files", waiting)

    def _certificate_end(self) -> Iterator[Metric]:
        if self._certificate is not None:
            name = "tidegate_certificate_end_timestamp_seconds"
            yield _gauge(name, "Expiry of the TLS certificate", self._certificate.ends_at.timestamp())

    def _logins(self) -> Iterator[Metric]:
        store = self._access.store
        yield _gauge("tidegate_logins_open", "Open log-ins", len(store.logins))
        now = store.now()
        locked = sum(lockout.wait_s(one, now) > 0 for one in list(store.attempts.values()))
        yield _gauge("tidegate_logins_locked", "Names and addresses locked out after failed log-ins", locked)
        refused = CounterMetricFamily("tidegate_refused", "Refused calls and log-ins", labels=["why"])
        for why, count in _refusals(self._access.refused_logins.total).items():
            refused.add_metric([why], count)
        yield refused


def _refusals(total: Mapping[str, int]) -> dict[str, int]:
    """Sum the refusals by label; unknown kinds count as OTHER."""
    found = dict.fromkeys([*REFUSAL_LABELS.values(), OTHER], 0)
    for kind, count in dict(total).items():
        found[REFUSAL_LABELS.get(kind, OTHER)] += count
    return found


def _gauge(name: str, description: str, value: float) -> Metric:
    return GaugeMetricFamily(name, description, value=value)
