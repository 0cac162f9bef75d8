"""Faults of the service's process and its engine's: killed, stopped, a thread dies or hangs, an interpreter is held."""

import random
import signal
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from verification.faults.kinds import (
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
    reported,
)
from verification.faults.masking_fault import beside
from verification.faults.verdict import Recovery

if TYPE_CHECKING:
    from verification.faults.rig import Rig

FAMILY = "process"
RECEIVER = "a process that is dead or frozen: the receiver's 200 ms"
LEASE = "the engine does not decide: the lease of 80 ms, and one exchange"
ONE_EXCHANGE_MS = 20.0
STOPPED = reported(
    *("frame_stale", "frame_late", "frame_missing", "watchdog", "frame_timeout", "beam_line_failed", "latency_high"),
    "service_silent",  # its reports meanwhile are read a moment after the engine continues
)
SILENT = reported("service_silent")
ENDED = reported("engine_failed", "session failed")
WRITING_MS = 1000.0
SILENCE = "the service may be silent for 500 ms, and beats every 30; then 100 ms"
SILENCE_MS = 500.0 + 30.0
SERVER_TICK_MS = 100.0
"""Uvicorn looks so often whether it was asked to go."""


def killed(rig: "Rig", _random: random.Random) -> Fault:
    return Fault(cause_ns=rig.signal(signal.SIGKILL))


def engine_killed(rig: "Rig", _random: random.Random) -> Fault:
    return Fault(cause_ns=rig.signal(signal.SIGKILL, rig.engine_pid))


def stopped(which: Callable[["Rig"], tuple[int, ...]]) -> Inject:
    """Let the scheduler give these processes nothing for a while."""

    def inject(rig: "Rig", chance: random.Random) -> Fault:
        pids = which(rig)

        def go_on() -> int:
            return rig.signal(signal.SIGCONT, *pids)

        return Fault(cause_ns=rig.signal(signal.SIGSTOP, *pids), undo=go_on, lasts_s=chance.uniform(0.05, 1.2))

    return inject


def asked_to_go(rig: "Rig", _random: random.Random) -> Fault:
    return Fault(cause_ns=rig.signal(signal.SIGTERM), undo=lambda: _wait_for_end(rig))


def _wait_for_end(rig: "Rig") -> None:
    assert rig.process is not None
    rig.process.wait(30.0)


def thread_dies(*where: str, in_engine: bool = True) -> Inject:
    def inject(rig: "Rig", _random: random.Random) -> Fault:
        return Fault(cause_ns=rig.sabotage("kill", *where, in_engine=in_engine))

    return inject


def interpreter_held(shortest_ms: float, longest_ms: float, *, in_engine: bool) -> Inject:
    def inject(rig: "Rig", chance: random.Random) -> Fault:
        ms = round(chance.uniform(shortest_ms, longest_ms))
        return Fault(cause_ns=rig.sabotage("hold", ms, in_engine=in_engine))

    return inject


def engine_hangs(shortest_ms: float, longest_ms: float) -> Inject:
    def inject(rig: "Rig", chance: random.Random) -> Fault:
        return Fault(cause_ns=rig.sabotage("hang", round(chance.uniform(shortest_ms, longest_ms)), in_engine=True))

    return inject


def engine_fails(rig: "Rig", _random: random.Random) -> Fault:
    return Fault(cause_ns=rig.sabotage("fail", "sabotaged", in_engine=True))


def loop_blocked(rig: "Rig", chance: random.Random) -> Fault:
    ms = round(chance.uniform(800.0, 1500.0))
    began_ns = rig.sabotage("loop", ms)
    return _for_a_while(began_ns, ms)


def files_gone(*, in_engine: bool) -> Inject:
    def inject(rig: "Rig", chance: random.Random) -> Fault:
        ms = round(chance.uniform(500.0, 1500.0))
        return _for_a_while(rig.sabotage("files", ms, in_engine=in_engine), ms)

    return inject


def memory_gone(*, in_engine: bool) -> Inject:
    def inject(rig: "Rig", chance: random.Random) -> Fault:
        ms = round(chance.uniform(500.0, 1500.0))
        return _for_a_while(rig.sabotage("memory", chance.choice((0, 2, 8)), ms, in_engine=in_engine), ms)

    return inject


def _for_a_while(began_ns: int, ms: float) -> Fault:
    end_s = began_ns / 1e9 + ms / 1e3

    def wait() -> None:
        time.sleep(max(end_s - time.monotonic(), 0.0))

    return Fault(cause_ns=began_ns, undo=wait, is_going=lambda: time.monotonic() < end_s)


def writer_hangs(rig: "Rig", chance: random.Random) -> Fault:
    ms = round(chance.uniform(1500.0, 3000.0))
    return _for_a_while(rig.sabotage("writer", ms), ms)


def _kind(code: str, what: str, inject: Inject, names: frozenset[str], recoveries: frozenset[Recovery], **more: object):
    return FaultKind(code=code, what=what, family=FAMILY, inject=inject, reported=names, recoveries=recoveries, **more)


KINDS = (
    _kind(
        *("killed", "kill -9 of the service", killed, reported("session interrupted"), RESTARTED),
        bound="its engine hears it at once: 100 ms",
    ),
    _kind(
        *("engine-killed", "kill -9 of the engine's process", engine_killed, ENDED, NEW_SESSION),
        bound=RECEIVER,
        bound_ms=RECEIVER_MS,
    ),
    _kind(
        *("stopped", "SIGSTOP of the service, SIGCONT later", stopped(lambda rig: (rig.pid,)), SILENT, LATCHED),
        bound=SILENCE,
        bound_ms=SILENCE_MS + FRAME_MS,
    ),
    _kind(
        *("engine-stopped", "SIGSTOP of the engine's process, SIGCONT later"),
        *(stopped(lambda rig: (rig.engine_pid,)), STOPPED, BY_ITSELF),
        bound=RECEIVER,
        bound_ms=RECEIVER_MS,
    ),
    _kind(
        *("frozen", "SIGSTOP of both processes, SIGCONT later"),
        *(stopped(lambda rig: (rig.pid, rig.engine_pid)), STOPPED, BY_ITSELF),
        bound=RECEIVER,
        bound_ms=RECEIVER_MS,
    ),
    _kind(
        *("terminated", "SIGTERM", asked_to_go, reported("engine_stopped"), RESTARTED),
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
        reported("watchdog"),
        LATCHED,
        bound=LEASE,
        bound_ms=LEASE_MS + ONE_EXCHANGE_MS,
    ),
    _kind(
        *(
            "capture-dies",
            "the thread that takes frames dies",
            thread_dies("openni-capture", "_take_frames"),
            reported("source_lost"),
            NEW_SESSION | LATCHED,
        ),
    ),
    _kind(
        *(
            "watchdog-dies",
            "the watchdog's thread dies",
            thread_dies("tidegate-watchdog"),
            reported("watchdog", "engine_failed"),
            NEW_SESSION,
        ),
        bound="found at the next decision: 100 ms",
    ),
    _kind(
        *("writer-dies", "the thread that writes the audit dies", thread_dies("tidegate-writer", in_engine=False)),
        reported("audit_behind", "engine_stopped", "session failed"),
        NEW_SESSION,
    ),
    _kind(
        *("writer-hangs", "the thread that writes the audit hangs for 1.5 to 3 s", writer_hangs),
        reported("recorder_behind", "audit_behind"),
        LATCHED,
        bound="what waits to be written may wait for 1 s, then 100 ms",
        bound_ms=WRITING_MS + FRAME_MS,
    ),
    _kind(
        *("line-dies", "the thread that tells the line dies", thread_dies("tidegate-beam-line")),
        reported("beam_line_failed"),
        frozenset({Recovery.NEW_SESSION, Recovery.ACKNOWLEDGED}),
        bound=RECEIVER,
        bound_ms=RECEIVER_MS,
    ),
    _kind(
        *("line-watch-dies", "the thread that watches the line dies", thread_dies("tidegate-beam-watch")),
        reported("beam_line_failed"),
        frozenset({Recovery.NEW_SESSION, Recovery.ACKNOWLEDGED}),
        bound="found at the next decision: 100 ms",
    ),
    _kind(
        *(
            "interpreter-held",
            "one thread holds the engine's interpreter for 300 to 700 ms",
            interpreter_held(300.0, 700.0, in_engine=True),
            STOPPED,
            BY_ITSELF,
        ),
        bound=RECEIVER,
        bound_ms=RECEIVER_MS,
    ),
    _kind(
        *("service-held", "one thread holds the service's interpreter for 0.8 to 1.5 s"),
        *(interpreter_held(800.0, 1500.0, in_engine=False), SILENT, LATCHED),
        bound=SILENCE,
        bound_ms=SILENCE_MS + FRAME_MS,
    ),
    _kind(
        *("beat-dies", "the thread that tells the engine of the service dies"),
        *(thread_dies("tidegate-engine-heartbeat", in_engine=False), SILENT, NEW_SESSION),
        bound=SILENCE,
        bound_ms=SILENCE_MS + FRAME_MS,
    ),
    _kind(
        *("news-dies", "the thread that receives from the engine's process dies"),
        *(thread_dies("tidegate-engine-updates", in_engine=False), SILENT | ENDED, NEW_SESSION),
    ),
    _kind(
        *("teller-dies", "the thread that tells the service dies"),
        *(thread_dies("tidegate-updates"), SILENT | ENDED | reported("recorder_behind", "audit_behind"), NEW_SESSION),
    ),
    _kind(
        *("hearer-dies", "the thread that receives from the service dies"),
        *(thread_dies("MainThread"), SILENT | ENDED, NEW_SESSION),
    ),
    _kind(
        *("loop-blocked", "the web server's event loop is blocked for 0.8 to 1.5 s", loop_blocked, SILENT, LATCHED),
        bound=SILENCE,
        bound_ms=SILENCE_MS + FRAME_MS,
    ),
    beside(
        _kind(
            *("files-gone", "the service has no file descriptor left, then a marker is covered"),
            *(files_gone(in_engine=False), reported(), BY_ITSELF),
        )
    ),
    beside(
        _kind(
            *("engine-files-gone", "its engine has no file descriptor left, then a marker is covered"),
            *(files_gone(in_engine=True), reported(), BY_ITSELF),
        )
    ),
    beside(
        _kind(
            *("memory-gone", "the service has no memory left, then a marker is covered", memory_gone(in_engine=False)),
            ENDED | STOPPED | reported("source_lost", "audit_behind", "recorder_behind", "session interrupted"),
            frozenset(Recovery),
            bound=SILENCE,
            bound_ms=SILENCE_MS + FRAME_MS,
        )
    ),
    beside(
        _kind(
            *("engine-memory-gone", "its engine has no memory left, then a marker is covered"),
            memory_gone(in_engine=True),
            ENDED | STOPPED | reported("source_lost", "audit_behind", "recorder_behind", "session interrupted"),
            frozenset(Recovery),
            bound=RECEIVER,
            bound_ms=RECEIVER_MS,
        )
    ),
)
