"""What a monitoring system reads about the session that runs: the gate, the queues, the engine's process."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from engine.live import LiveView
from engine.permits import GateState, HoldReason
from service.ports import EnginePort, RunningEngine
from service.room import Room

MS_PER_S = 1000.0
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
TICKS_A_SECOND = os.sysconf("SC_CLK_TCK")
QUEUES = ("samples", "transitions", "notices")


class EngineMetrics(Collector):
    """What is true of the running session now; read when asked."""

    def __init__(self, room: Room, engine: EnginePort | None = None) -> None:
        self._room = room
        self._engine = engine

    def describe(self) -> list[Metric]:
        """Name nothing beforehand: the registry need not ask a room that is not there yet."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Read the newest view; what is not known is left out, never zero."""
        running = self._room.running
        yield _gauge("tidegate_session_running", "Whether a session runs", float(running is not None))
        yield _gauge("tidegate_qa_running", "Whether a QA run has the room", float(self._room.qa_run_id is not None))
        lost = getattr(self._engine, "processes_lost", None)
        if lost is not None:
            yield CounterMetricFamily(
                "tidegate_engine_processes_lost", "Engine processes that ended though nobody told them to", value=lost
            )
        if running is None:
            return
        yield from _queues(running.engine)
        yield from _process(getattr(running.engine, "process_id", None))
        view = running.engine.latest
        if view is not None:
            yield from _states(view)


def _states(view: LiveView) -> Iterator[Metric]:
    state = GaugeMetricFamily("tidegate_gate_state", "1 for the state the gate is in", labels=["state"])
    for one in GateState:
        state.add_metric([one.value], float(view.record.gate_state is one))
    yield state
    reason = GaugeMetricFamily("tidegate_hold_reason", "1 for why the beam is held", labels=["reason"])
    for why in HoldReason:
        reason.add_metric([why.value], float(view.record.hold_reason is why))
    yield reason
    yield _gauge("tidegate_armed", "Whether the gate decides by itself", float(view.is_armed))
    yield _gauge("tidegate_line_on", "The beam line as read back", float(view.record.line_on))
    yield _gauge("tidegate_operator_hold", "Whether a person holds the beam", float(view.operator_hold is not None))
    yield _gauge("tidegate_fps", "Frames a second over the last second", view.fps)
    yield _gauge("tidegate_dropped_records", "Records the session's recorder could not take", view.dropped_records)
    times = GaugeMetricFamily(
        "tidegate_latency_recent_seconds",
        "From capture to the line told: so many of the last few hundred frames took no longer; 1 is the whole session",
        labels=["share"],
    )
    for share, time_ms in (
        ("0.5", view.latency.p50_ms),
        ("0.99", view.latency.p99_ms),
        ("1", view.latency.max_ms),
    ):
        times.add_metric([share], time_ms / MS_PER_S)
    yield times


def _queues(engine: RunningEngine) -> Iterator[Metric]:
    sizes = GaugeMetricFamily("tidegate_queue_size", "What waits to be written down", labels=["queue"])
    rooms = GaugeMetricFamily("tidegate_queue_capacity", "How much may wait before the gate holds", labels=["queue"])
    for name in QUEUES:
        waiting = getattr(engine, name)
        sizes.add_metric([name], waiting.qsize())
        rooms.add_metric([name], waiting.maxsize)
    yield sizes
    yield rooms


def _process(process_id: int | None) -> Iterator[Metric]:
    """Read how the engine's own process is, where it has one; one that has just ended is left out."""
    if process_id is None:
        return
    with contextlib.suppress(OSError, ValueError, IndexError):
        folder = Path("/proc") / str(process_id)
        pages = int((folder / "statm").read_text(encoding="ascii").split()[1])
        # The name in front may hold anything, but no second closing bracket comes after it.
        fields = (folder / "stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        seconds, threads = (int(fields[11]) + int(fields[12])) / TICKS_A_SECOND, int(fields[17])
        resident = "tidegate_engine_process_resident_memory_bytes"
        yield _gauge(resident, "Memory of the engine's process", pages * PAGE_BYTES)
        yield CounterMetricFamily(
            "tidegate_engine_process_cpu_seconds", "Processor time of the engine's process", value=seconds
        )
        yield _gauge("tidegate_engine_process_threads", "Threads of the engine's process", threads)


def _gauge(name: str, words: str, value: float) -> Metric:
    return GaugeMetricFamily(name, words, value=value)
