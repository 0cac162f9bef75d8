"""Metrics of the running session: gate, queues and engine process."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from engine.beam import BeamOnState
from engine.control import LiveView
from engine.core.gate_state import GateState, HoldReason
from service.engine_host.equipment import EquipmentSlot
from service.engine_host.protocols import EnginePort, RunningEngine

MS_PER_S = 1000.0
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
TICKS_A_SECOND = os.sysconf("SC_CLK_TCK")
QUEUES = ("samples", "transitions", "notices")


class EngineMetrics(Collector):
    """Metrics of the running session, read at every scrape."""

    def __init__(self, equipment: EquipmentSlot, engine: EnginePort | None = None) -> None:
        self._equipment = equipment
        self._engine = engine

    def describe(self) -> list[Metric]:
        """Return nothing: at registration the equipment does not exist yet."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Read the newest view; an unknown value is omitted, never reported as zero."""
        running = self._equipment.running
        yield _gauge("tidegate_session_running", "1 while a session runs", float(running is not None))
        yield _gauge(
            "tidegate_qa_running",
            "1 while a QA run uses camera and beam line",
            float(self._equipment.qa_run_id is not None),
        )
        lost = getattr(self._engine, "processes_lost", None)
        if lost is not None:
            yield CounterMetricFamily(
                "tidegate_engine_processes_lost", "Engine processes that ended unexpectedly", value=lost
            )
        if running is None:
            return
        yield from _queues(running.engine)
        yield from _process(getattr(running.engine, "process_id", None))
        view = running.engine.status.view
        if view is not None:
            yield from _states(view)


def _states(view: LiveView) -> Iterator[Metric]:
    state = GaugeMetricFamily("tidegate_gate_state", "1 for the current state of the gate", labels=["state"])
    for one in GateState:
        state.add_metric([one.value], float(view.record.gate_state is one))
    yield state
    reason = GaugeMetricFamily("tidegate_hold_reason", "1 for the current hold reason", labels=["reason"])
    for why in HoldReason:
        reason.add_metric([why.value], float(view.record.hold_reason is why))
    yield reason
    yield _gauge("tidegate_armed", "1 while the gate is armed", float(view.is_armed))
    yield _gauge("tidegate_line_on", "1 while the beam line reads back on", float(view.record.line_on))
    if view.beam_on is not None:
        yield from _beam_on(view.beam_on)
    yield _gauge("tidegate_operator_hold", "1 while an operator holds the beam", float(view.operator_hold is not None))
    yield _gauge("tidegate_fps", "Frames per second over the last second", view.fps)
    yield _gauge("tidegate_dropped_records", "Records that the session's recorder dropped", view.dropped_records)
    times = GaugeMetricFamily(
        "tidegate_latency_recent_seconds",
        "Time from capture to the beam line command: quantile over the last few hundred frames; 1: session maximum",
        labels=["share"],
    )
    for share, time_ms in (
        ("0.5", view.latency.p50_ms),
        ("0.99", view.latency.p99_ms),
        ("1", view.latency.max_ms),
    ):
        times.add_metric([share], time_ms / MS_PER_S)
    yield times


def _beam_on(state: BeamOnState) -> Iterator[Metric]:
    """Report the accelerator's beam-on signal; an unknown value is omitted."""
    if state.is_on is not None:
        yield _gauge("tidegate_accelerator_beam_on", "1 while the accelerator reports beam on", float(state.is_on))
    yield _gauge(
        "tidegate_beam_absent",
        "1 after beam.absent_s of permitted time without a beam",
        float(state.is_absent),
    )
    yield CounterMetricFamily(
        "tidegate_beam_absences", "Times that the beam was permitted for too long without one", value=state.absences
    )
    times = GaugeMetricFamily(
        "tidegate_beam_off_seconds", "Time from the end of a permit to the accelerator's beam off", labels=["hold"]
    )
    for hold, off_ms in (("last", state.last_off_ms), ("slowest", state.slowest_off_ms)):
        if off_ms is not None:
            times.add_metric([hold], off_ms / MS_PER_S)
    yield times


def _queues(engine: RunningEngine) -> Iterator[Metric]:
    sizes = GaugeMetricFamily("tidegate_queue_size", "Entries that wait to be written", labels=["queue"])
    capacities = GaugeMetricFamily(
        "tidegate_queue_capacity", "Entries at which the gate holds the beam", labels=["queue"]
    )
    for name in QUEUES:
        waiting = getattr(engine, name)
        sizes.add_metric([name], waiting.qsize())
        capacities.add_metric([name], waiting.maxsize)
    yield sizes
    yield capacities


def _process(process_id: int | None) -> Iterator[Metric]:
    """Read memory, processor time and threads of the engine process from /proc; omitted if there is none."""
    if process_id is None:
        return
    with contextlib.suppress(OSError, ValueError, IndexError):
        folder = Path("/proc") / str(process_id)
        pages = int((folder / "statm").read_text(encoding="ascii").split()[1])
        # The process name may contain any character; the last closing bracket ends it.
        fields = (folder / "stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        seconds, threads = (int(fields[11]) + int(fields[12])) / TICKS_A_SECOND, int(fields[17])
        resident = "tidegate_engine_process_resident_memory_bytes"
        yield _gauge(resident, "Memory of the engine's process", pages * PAGE_BYTES)
        yield CounterMetricFamily(
            "tidegate_engine_process_cpu_seconds", "Processor time of the engine's process", value=seconds
        )
        yield _gauge("tidegate_engine_process_threads", "Threads of the engine's process", threads)


def _gauge(name: str, description: str, value: float) -> Metric:
    return GaugeMetricFamily(name, description, value=value)
