"""Faults of the machine around it: its clock, its disk, its database, its processors, and everybody who calls."""

import contextlib
import os
import random
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import httpx2
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from verification.faults.kinds import (
    BY_ITSELF,
    FRAME_MS,
    LAG_MS,
    LATCHED,
    LEASE_MS,
    NEW_SESSION,
    RECEIVER_MS,
    Fault,
    FaultKind,
    Inject,
    reported,
)
from verification.faults.masking_fault import beside
from verification.faults.operator import NAME
from verification.faults.plan import OWN_CLOCK
from verification.faults.verdict import Recovery

if TYPE_CHECKING:
    from verification.faults.rig import Rig

FAMILY = "host"
HOUR_S = 3600
INSIST_S = 1.2
PAGE_BYTES = 4096
FILL_TRIES = 5
LITTLE_BYTES = 8 * 2**20
"""Too little for the site, enough to write down who acknowledges."""

WRITER_MS = 250.0 + 500.0
"""A batch of samples is written every 250 ms, and a locked database is waited for 500 ms."""

DISK_LOOK_MS = 1000.0
MOST_CALLS = 400
CALLERS, CLIENTS = 8, 24
BUSY_LOOP = "while True: pass"
MADE_UP: tuple[dict[str, str], ...] = (
    {},
    {"Authorization": "Bearer tg_00000000_made-up"},
    {"Cookie": "tidegate=made-up", "Origin": "http://elsewhere.example"},
)
"""What somebody sends whom no one let in."""


def wall_clock(hours: int) -> Inject:
    """Change the wall clock of the service's process, in one step."""

    def inject(rig: "Rig", _random: random.Random) -> Fault:
        at_ns = time.monotonic_ns()
        rig.wall_clock.set(hours * HOUR_S)

        def back() -> None:
            rig.wall_clock.set(0.0)

        return Fault(cause_ns=at_ns, undo=back)

    return inject


def disk_full(rig: "Rig", _random: random.Random, left_bytes: int = 0) -> Fault:
    """Fill the data folder's file system, to the last byte or but for a little."""
    ballast = rig.data / "ballast"
    at_ns = time.monotonic_ns()
    with ballast.open("wb", buffering=0) as file:
        for _ in range(FILL_TRIES):  # refused as a whole when the service takes a page meanwhile
            free = os.statvfs(rig.data).f_bavail * os.statvfs(rig.data).f_frsize
            with contextlib.suppress(OSError):
                os.posix_fallocate(file.fileno(), 0, max(free - max(left_bytes, PAGE_BYTES), 1))
                break
        file.seek(0, os.SEEK_END)
        with contextlib.suppress(OSError):
            while not left_bytes:
                file.write(bytes(PAGE_BYTES))

    return Fault(cause_ns=at_ns, undo=ballast.unlink, lasts_s=0.1)


def disk_full_acknowledged(rig: "Rig", chance: random.Random) -> Fault:
    """Fill it, and let somebody acknowledge and arm again and again while it is full."""

    def insist() -> None:
        end_s = time.monotonic() + INSIST_S
        while time.monotonic() < end_s:
            for action in ("acknowledge", "arm"):
                with contextlib.suppress(httpx2.HTTPError):
                    rig.person.act(action)

    return replace(disk_full(rig, chance, left_bytes=LITTLE_BYTES), meanwhile=insist)


def database_locked(shortest_s: float, longest_s: float) -> Inject:
    """Let another program hold the database's write lock."""

    def inject(rig: "Rig", chance: random.Random) -> Fault:
        seconds = chance.uniform(shortest_s, longest_s)
        began = threading.Event()
        began_ns: list[int] = []

        def hold() -> None:
            with contextlib.closing(sqlite3.connect(rig.data / "tidegate.db", timeout=5.0)) as other:
                other.isolation_level = None
                other.execute("BEGIN IMMEDIATE")
                began_ns.append(time.monotonic_ns())
                began.set()
                time.sleep(seconds)
                other.execute("ROLLBACK")

        holder = threading.Thread(target=hold, daemon=True)
        holder.start()
        assert began.wait(10.0)
        return Fault(cause_ns=began_ns[0], undo=holder.join, is_going=holder.is_alive)

    return inject


def database_gone(rig: "Rig", _random: random.Random) -> Fault:
    """Take the database's file away under the service's hands, and put it back."""
    files = [path for path in rig.data.glob("tidegate.db*") if path.is_file()]
    aside = rig.data / "aside"
    aside.mkdir(exist_ok=True)
    at_ns = time.monotonic_ns()
    for path in files:
        path.rename(aside / path.name)

    def back() -> None:
        for path in files:
            (aside / path.name).replace(path)

    return Fault(cause_ns=at_ns, undo=back, lasts_s=0.1)


def processors_busy(rig: "Rig", chance: random.Random) -> Fault:
    """Keep every processor busy with two processes more than there are, for as long as the fault lasts."""
    many = (os.cpu_count() or 1) + 2
    at_ns = time.monotonic_ns()
    busy = [subprocess.Popen([sys.executable, "-c", BUSY_LOOP]) for _ in range(many)]

    def rest() -> None:
        for one in busy:
            one.kill()
            one.wait()

    return Fault(cause_ns=at_ns, undo=rest, lasts_s=chance.uniform(0.1, 0.5))


def call_flood(rig: "Rig", chance: random.Random) -> Fault:
    """Call the API from eight threads, a bounded number of times, with everything a client may send, and more."""
    calls = _calls(rig, chance)
    return _many(CALLERS, lambda number, over: _caller(rig, calls, number, over, rig.person.headers))


def stranger_flood(rig: "Rig", chance: random.Random) -> Fault:
    """The same from eight threads that no one knows, who try to log in besides, and show keys that they made up."""
    calls = _calls(rig, chance) + [("POST", "/api/v1/login", {"name": "Mallory", "password": "let me in, please"})] * 5
    chance.shuffle(calls)
    return _many(CALLERS, lambda number, over: _caller(rig, calls, number, over, MADE_UP[number % len(MADE_UP)]))


def client_flood(rig: "Rig", _random: random.Random) -> Fault:
    """Open more live streams than there may be, and read none of them."""
    return _many(CLIENTS, lambda _number, over: _silent_client(rig, over))


def _calls(rig: "Rig", chance: random.Random) -> list[tuple[str, str, object]]:
    session = f"/api/v1/sessions/{rig.person.session_id}"
    calls: list[tuple[str, str, object]] = [
        ("GET", session, None),
        ("GET", "/api/v1/audit?limit=200", None),
        ("GET", f"{session}/picture", None),
        ("GET", f"{session}/mesh", None),
        ("GET", f"{session}/transitions", None),
        ("GET", "/metrics", None),
        ("GET", "/api/v1/audit/verify", None),
        ("POST", f"{session}/arm", {"operator": "Nobody"}),
        ("POST", f"{session}/acknowledge", {"operator": NAME}),
        ("POST", f"{session}/start", {"operator": NAME}),
        ("POST", f"{session}/baseline-correction", {"operator": NAME, "by_mm": 1e9, "drift_mm": "a"}),
        ("POST", "/api/v1/sessions", {"operator": "Nobody" * 1000}),
        ("POST", f"{session}/arm", {"operator": "Nobody", "extra": list(range(2000))}),
        ("DELETE", session, None),
    ]
    chance.shuffle(calls)
    return calls


def _caller(
    rig: "Rig", calls: list[tuple[str, str, object]], number: int, over: threading.Event, headers: dict[str, str]
) -> None:
    with httpx2.Client(base_url=f"http://127.0.0.1:{rig.port}", timeout=20.0, headers=headers) as client:
        for index in range(MOST_CALLS // CALLERS):
            if over.is_set():
                return
            method, path, body = calls[(index + number) % len(calls)]
            with contextlib.suppress(httpx2.HTTPError):
                client.request(method, path, json=body)


def _silent_client(rig: "Rig", over: threading.Event) -> None:
    url = f"ws://127.0.0.1:{rig.port}/api/v1/live"
    with (
        contextlib.suppress(OSError, WebSocketException),
        connect(url, additional_headers=rig.key_headers) as socket,
    ):
        over.wait(20.0)
        socket.close()


def _many(count: int, work: Callable[[int, threading.Event], None]) -> Fault:
    over = threading.Event()
    threads = [threading.Thread(target=work, args=(number, over), daemon=True) for number in range(count)]
    at_ns = time.monotonic_ns()
    for thread in threads:
        thread.start()

    def end() -> None:
        over.set()
        for thread in threads:
            thread.join()

    return Fault(cause_ns=at_ns, undo=end, is_going=lambda: any(thread.is_alive() for thread in threads))


def _kind(code: str, what: str, inject: Inject, names: frozenset[str], recoveries: frozenset[Recovery], **more: object):
    return FaultKind(code=code, what=what, family=FAMILY, inject=inject, reported=names, recoveries=recoveries, **more)


FULL = reported("disk_low", "audit_behind", "recorder_behind")

KINDS = (
    beside(
        _kind(
            "clock-ahead",
            "the wall clock jumps 1 h ahead, then a marker is covered",
            wall_clock(1),
            reported(),
            BY_ITSELF,
            plan=OWN_CLOCK,
        )
    ),
    beside(
        _kind(
            "clock-behind",
            "the wall clock jumps 1 h back, then a marker is covered",
            wall_clock(-1),
            reported(),
            BY_ITSELF,
            plan=OWN_CLOCK,
        )
    ),
    _kind(
        *("disk-full", "the disk is full to the last byte", disk_full, FULL, LATCHED),
        bound="looked at every second, and at each batch",
        bound_ms=DISK_LOOK_MS + FRAME_MS,
    ),
    _kind(
        *("disk-full-insisted", "the disk is almost full, and a person acknowledges and arms"),
        *(disk_full_acknowledged, FULL, LATCHED),
        bound="looked at every second",
        bound_ms=DISK_LOOK_MS + FRAME_MS,
    ),
    _kind(
        *(
            "database-locked",
            "another program locks the database for 2 to 4 s",
            database_locked(2.0, 4.0),
            FULL,
            LATCHED,
        ),
        bound="a batch of 250 ms, 500 ms of patience, then 100 ms",
        bound_ms=WRITER_MS + FRAME_MS,
    ),
    beside(
        _kind(
            *("database-busy", "it is locked for less than the patience, then a marker is covered"),
            *(database_locked(0.40, 0.46), reported(), BY_ITSELF),
        ),
        latest_s=0.2,
    ),
    _kind(
        *("database-gone", "the database's file is taken away", database_gone, FULL, LATCHED | NEW_SESSION),
        bound="looked at every second",
        bound_ms=DISK_LOOK_MS + FRAME_MS,
    ),
    beside(
        _kind(
            *("processors-busy", "every processor is busy with others, then a marker is covered", processors_busy),
            reported("frame_late", "frame_missing", "frame_stale", "frame_timeout", "latency_high", "watchdog")
            | reported("beam_line_failed", "frame_rate_low"),
            BY_ITSELF,
            bound="lag of a frame, lease, and the receiver's 200 ms",
            bound_ms=LAG_MS + LEASE_MS + RECEIVER_MS,
            may_be_disturbed=False,
        )
    ),
    beside(
        _kind(
            *("call-flood", "400 API calls from 8 clients, then a marker is covered", call_flood),
            reported("frame_late", "frame_missing", "frame_stale", "latency_high", "watchdog", "beam_line_failed"),
            BY_ITSELF,
        )
    ),
    beside(
        _kind(
            *("stranger-flood", "400 calls and log-ins of 8 unknown callers, then a marker is covered", stranger_flood),
            reported("frame_late", "frame_missing", "frame_stale", "latency_high", "watchdog", "beam_line_failed"),
            BY_ITSELF,
        )
    ),
    beside(
        _kind(
            *("client-flood", "24 live streams that are not read, then a marker is covered", client_flood),
            reported("frame_late", "frame_missing", "frame_stale", "latency_high", "watchdog", "beam_line_failed"),
            BY_ITSELF,
        )
    ),
)
