"""Metrics of the slots by which a department follows this room's PostgreSQL database; none for SQLite.

The room reports them, because it is the room whose disk keeps what a department has not fetched.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from prometheus_client.core import GaugeMetricFamily, Metric
from sqlalchemy import text
from sqlalchemy.orm import Session

SLOTS = text(
    "SELECT slot_name AS name, active AS is_active, wal_status IS NOT DISTINCT FROM 'lost' AS is_lost, "
    "CASE WHEN pg_is_in_recovery() THEN NULL "
    "ELSE pg_wal_lsn_diff(pg_current_wal_lsn(), confirmed_flush_lsn)::bigint END AS behind_bytes, "
    "pg_size_bytes(current_setting('max_slot_wal_keep_size')) AS limit_bytes "
    "FROM pg_replication_slots WHERE slot_type = 'logical' AND database = current_database() ORDER BY slot_name"
)


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
