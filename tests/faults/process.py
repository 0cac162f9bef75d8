"""Faults of the process: killed, stopped, a thread that dies or hangs, the interpreter held, memory and files gone."""

import random
import signal
import time
from typing import TYPE_CHECKING

from tests.faults.beside import beside
from tests.faults.kinds import (
    BY_ITSELF,
    FRAME_MS,
    LATCHED,
    LEASE_MS,
    NEW_SESSION,
    RECEIVER_MS,
    RESTARTED,
    Fault,
    FaultKind,
    Inject,
    told,
)
from tests.faults.verdict import Recovery

if TYPE_CHECKING:
    from tests.faults.rig import Rig

FAMILY = "process"
RECEIVER = "a process that is dead or frozen: the receiver's 200 ms"
LEASE = "the engine does not decide: the lease of 80 ms, and one exchange"
ONE_EXCHANGE_MS = 20.0
STOPPED = told(
    "frame_stale", "frame_late", "frame_missing", "watchdog", "frame_timeout", "beam_line_failed", "latency_high"
)
ENDED = told("engine_failed", "session failed")
WRITING_MS = 1000.0
SERVER_TICK_MS = 100.0
"""Uvicorn looks so often whether it was told to go."""


def killed(rig: "Rig", _random: random.Random) -> Fault:
    return Fault(cause_ns=rig.signal(signal.SIGKILL))


def stopped(rig: "Rig", chance: random.Random) -> Fault:
    cause_ns = rig.signal(signal.SIGSTOP)

    def go_on() -> int:
        return rig.signal(signal.SIGCONT)

    return Fault(cause_ns=cause_ns, undo=go_on, lasts_s=chance.uniform(0.05, 1.2))


def told_to_go(rig: "Rig", _random: random.Random) -> Fault:
    return Fault(cause_ns=rig.signal(signal.SIGTERM), undo=lambda: _wait_for_end(rig))


def _wait_for_end(rig: "Rig") -> None:
    assert rig.process is not None
    rig.process.wait(30.0)


def thread_dies(*where: str) -> Inject:
    def inject(rig: "Rig", _random: random.Random) -> Fault:
        return Fault(cause_ns=rig.sabotage("kill", *where))

    return inject


def interpreter_held(rig: "Rig", chance: random.Random) -> Fault:
    return Fault(cause_ns=rig.sabotage("hold", round(chance.uniform(300.0, 700.0))))


def engine_hangs(shortest_ms: float, longest_ms: float) -> Inject:
    def inject(rig: "Rig", chance: random.Random) -> Fault:
        return Fault(cause_ns=rig.sabotage("hang", round(chance.uniform(shortest_ms, longest_ms))))

    return inject


def engine_fails(rig: "Rig", _random: random.Random) -> Fault:
    return Fault(cause_ns=rig.sabotage("fail", "sabotaged"))


def loop_blocked(rig: "Rig", chance: random.Random) -> Fault:
    ms = round(chance.uniform(500.0, 1500.0))
    began_ns = rig.sabotage("loop", ms)
    return _for_a_while(began_ns, ms)


def files_gone(rig: "Rig", chance: random.Random) -> Fault:
    ms = round(chance.uniform(500.0, 1500.0))
    began_ns = rig.sabotage("files", ms)
    return _for_a_while(began_ns, ms)


def memory_gone(rig: "Rig", chance: random.Random) -> Fault:
    ms = round(chance.uniform(500.0, 1500.0))
    began_ns = rig.sabotage("memory", chance.choice((0, 2, 8)), ms)
    return _for_a_while(began_ns, ms)


def _for_a_while(began_ns: int, ms: float) -> Fault:
    end_s = began_ns / 1e9 + ms / 1e3

    def wait() -> None:
        time.sleep(max(end_s - time.monotonic(), 0.0))

    return Fault(cause_ns=began_ns, undo=wait, is_going=lambda: time.monotonic() < end_s)


def writer_hangs(rig: "Rig", chance: random.Random) -> Fault:
    ms = round(chance.uniform(1500.0, 3000.0))
    return _for_a_while(rig.sabotage("writer", ms), ms)


def _kind(code: str, what: str, inject: Inject, names: frozenset[str], recoveries: frozenset[Recovery], **more: object):
    return FaultKind(code=code, what=what, family=FAMILY, inject=inject, told=names, recoveries=recoveries, **more)


KINDS = (
    _kind(
        *("killed", "kill -9 of the process", killed, told("session interrupted"), RESTARTED),
        bound=RECEIVER,
        bound_ms=RECEIVER_MS,
    ),
    _kind(
        *("stopped", "SIGSTOP of the process, SIGCONT later", stopped, STOPPED, BY_ITSELF),
        bound=RECEIVER,
        bound_ms=RECEIVER_MS,
    ),
    _kind(
        *("terminated", "SIGTERM", told_to_go, told("engine_stopped"), RESTARTED),
        bound="the server looks every 100 ms, then 100 ms",
        bound_ms=SERVER_TICK_MS + FRAME_MS,
    ),
    _kind("engine-dies", "the engine's thread is torn down", thread_dies("tidegate-engine"), ENDED, NEW_SESSION),
    _kind(
        *("engine-fails", "measuring a frame raises", engine_fails, ENDED, NEW_SESSION),
    ),
    _kind(
        *(
            "engine-hesitates",
            "the engine's thread hangs for 110 to 160 ms",
            engine_hangs(110.0, 160.0),
            STOPPED,
            BY_ITSELF,
        ),
        bound=LEASE,
        bound_ms=LEASE_MS + ONE_EXCHANGE_MS,
    ),
    _kind(
        *("engine-hangs", "the engine's thread hangs for 300 to 1500 ms", engine_hangs(300.0, 1500.0)),
        told("watchdog"),
        LATCHED,
        bound=LEASE,
        bound_ms=LEASE_MS + ONE_EXCHANGE_MS,
    ),
    _kind(
        *(
            "capture-dies",
            "the thread that takes frames dies",
            thread_dies("openni-capture", "_take_frames"),
            told("source_lost"),
            NEW_SESSION | LATCHED,
        ),
    ),
    _kind(
        *(
            "watchdog-dies",
            "the watchdog's thread dies",
            thread_dies("tidegate-watchdog"),
            told("watchdog", "engine_failed"),
            NEW_SESSION,
        ),
        bound="found at the next decision: 100 ms",
    ),
    _kind(
        *("writer-dies", "the thread that writes the audit dies", thread_dies("tidegate-writer")),
        told("audit_behind", "engine_stopped", "session failed"),
        NEW_SESSION,
    ),
    _kind(
        *("writer-hangs", "the thread that writes the audit hangs for 1.5 to 3 s", writer_hangs),
        told("recorder_behind", "audit_behind"),
        LATCHED,
        bound="what waits to be written may wait for 1 s, then 100 ms",
        bound_ms=WRITING_MS + FRAME_MS,
    ),
    _kind(
        *("line-dies", "the thread that tells the line dies", thread_dies("tidegate-beam-line")),
        told("beam_line_failed"),
        frozenset({Recovery.NEW_SESSION, Recovery.ACKNOWLEDGED}),
        bound=RECEIVER,
        bound_ms=RECEIVER_MS,
    ),
    _kind(
        *("line-watch-dies", "the thread that watches the line dies", thread_dies("tidegate-beam-watch")),
        told("beam_line_failed"),
        frozenset({Recovery.NEW_SESSION, Recovery.ACKNOWLEDGED}),
        bound="found at the next decision: 100 ms",
    ),
    _kind(
        *(
            "interpreter-held",
            "one thread holds the interpreter for 300 to 700 ms",
            interpreter_held,
            STOPPED,
            BY_ITSELF,
        ),
        bound=RECEIVER,
        bound_ms=RECEIVER_MS,
    ),
    beside(
        _kind(
            "loop-blocked",
            "the web server's event loop is blocked, then a marker is covered",
            loop_blocked,
            told(),
            BY_ITSELF,
        )
    ),
    beside(_kind("files-gone", "no file descriptor is left, then a marker is covered", files_gone, told(), BY_ITSELF)),
    beside(
        _kind(
            *("memory-gone", "no memory is left, then a marker is covered", memory_gone),
            ENDED | STOPPED | told("source_lost", "audit_behind", "session interrupted"),
            frozenset(Recovery),
            bound=RECEIVER,
            bound_ms=RECEIVER_MS,
        )
    ),
)
