"""What following a room costs, measured, and what sixteen rooms would cost, calculated from it."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from tests.support.department.replication import answer
from verification.department.hub import Hub
from verification.department.room import Room

HOUR_S = 3600.0
SCRAPE_EVERY_S = 5.0
MANY = 16
SETTLE_S, IDLE_S = 30.0, 120.0
SESSIONS = 6
MB, GB = 1e6, 1e9
BOUND_BYTES = 4 * 1024**3
"""What docker/department/replication/room.conf lets a room keep."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Counters:
    """What has been used so far, by all rooms together."""

    at_s: float
    log_bytes: float
    network_bytes: int
    hub_bytes: int
    hub_processor_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """Of one room, a second."""

    log_bytes: float
    network_bytes: float
    hub_bytes: float
    hub_processor_s: float
    metrics_bytes: float


def read(hub: Hub, rooms: Sequence[Room]) -> Counters:
    """Read all counters."""
    position = "SELECT pg_wal_lsn_diff(pg_current_wal_lsn(), '0/0')::float8"
    return Counters(
        at_s=time.monotonic(),
        log_bytes=sum(float(str(answer(room.server, room.name, position))) for room in rooms),
        network_bytes=sum(room.cable.bytes_passed() for room in rooms),
        hub_bytes=hub.size_bytes(),
        hub_processor_s=hub.processor_s(),
    )


def measure(hub: Hub, rooms: Sequence[Room], during: Callable[[], None]) -> Cost:
    """Measure while something is done."""
    before = read(hub, rooms)
    during()
    after = read(hub, rooms)
    each = (after.at_s - before.at_s) * len(rooms)
    return Cost(
        log_bytes=(after.log_bytes - before.log_bytes) / each,
        network_bytes=(after.network_bytes - before.network_bytes) / each,
        hub_bytes=(after.hub_bytes - before.hub_bytes) / each,
        hub_processor_s=(after.hub_processor_s - before.hub_processor_s) / each,
        metrics_bytes=max(room.read().scrape_bytes for room in rooms) / SCRAPE_EVERY_S,
    )


def table(idle: Cost, gating: Cost) -> str:
    """Return the table for the document; the last column is calculated."""
    lines = ["| | room, idle | room, gating | sixteen rooms, all gating (calculated) |", "|---|---|---|---|"]
    rows = [
        ("log written by the room's PostgreSQL, MB an hour", "log_bytes", HOUR_S / MB),
        ("network, room and hub, both ways, MB an hour", "network_bytes", HOUR_S / MB),
        ("growth of the hub's databases, MB an hour", "hub_bytes", HOUR_S / MB),
        ("metrics, uncompressed, every 5 s, MB an hour", "metrics_bytes", HOUR_S / MB),
        ("hub's PostgreSQL, per cent of a core", "hub_processor_s", 100.0),
    ]
    for words, name, factor in rows:
        here, there = getattr(idle, name) * factor, getattr(gating, name) * factor
        lines.append(f"| {words} | {here:.2f} | {there:.2f} | {there * MANY:.1f} |")
    hours = BOUND_BYTES / gating.log_bytes / HOUR_S if gating.log_bytes else 0.0
    lines.append(f"| hub away until 4 GB are reached, hours | | {hours:.0f} | |")
    return "\n".join(lines)
