"""What a monitoring system reads at ``/metrics``: counts, times and states; no patient, no plan, no person.

Counters are :class:`service.tallies.Tallies`; states are read from the newest view when somebody asks. Nothing here is
called by the engine's thread.
"""

from collections.abc import Iterator

from prometheus_client import generate_latest
from prometheus_client.core import GaugeMetricFamily, InfoMetricFamily, Metric
from prometheus_client.registry import Collector

from engine import __version__
from engine.live import LiveView
from engine.permits import GateState
from service.ports import RunningEngine
from service.room import Room
from service.tallies import Tallies

MS_PER_S = 1000.0


class Metrics:
    """Counters and states in the text format of Prometheus."""

    def __init__(self, tallies: Tallies, room: Room) -> None:
        self._registry = tallies.registry
        self._registry.register(_Present(room))

    def text(self) -> bytes:
        """Write them all."""
        return generate_latest(self._registry)


class _Present(Collector):
    """What is true now; read when asked."""

    def __init__(self, room: Room) -> None:
        self._room = room

    def describe(self) -> list[Metric]:
        """Name nothing beforehand: the registry need not ask a room that is not there yet."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Read the newest view; what is not known is left out, never zero."""
        running = self._room.running
        yield InfoMetricFamily("tidegate_build", "The software", {"version": __version__})
        yield _gauge("tidegate_session_running", "Whether a session runs", float(running is not None))
        if running is None:
            return
        yield _queues(running.engine)
        view = running.engine.latest
        if view is not None:
            yield from _states(view)


def _states(view: LiveView) -> Iterator[Metric]:
    state = GaugeMetricFamily("tidegate_gate_state", "1 for the state the gate is in", labels=["state"])
    for one in GateState:
        state.add_metric([one.value], float(view.record.gate_state is one))
    yield state
    yield _gauge("tidegate_armed", "Whether the gate decides by itself", float(view.is_armed))
    yield _gauge("tidegate_line_on", "The beam line as read back", float(view.record.line_on))
    yield _gauge("tidegate_operator_hold", "Whether a person holds the beam", float(view.operator_hold is not None))
    yield _gauge("tidegate_fps", "Frames a second over the last second", view.fps)
    yield _gauge("tidegate_dropped_records", "Records the session's recorder could not take", view.dropped_records)
    times = GaugeMetricFamily(
        "tidegate_latency_recent_seconds", "Of the last few hundred frames; 1 is the whole session", labels=["quantile"]
    )
    for quantile, time_ms in (
        ("0.5", view.latency.p50_ms),
        ("0.99", view.latency.p99_ms),
        ("1", view.latency.max_ms),
    ):
        times.add_metric([quantile], time_ms / MS_PER_S)
    yield times


def _queues(engine: RunningEngine) -> Metric:
    sizes = GaugeMetricFamily("tidegate_queue_size", "What waits to be written down", labels=["queue"])
    sizes.add_metric(["samples"], engine.samples.qsize())
    sizes.add_metric(["transitions"], engine.transitions.qsize())
    sizes.add_metric(["notices"], engine.notices.qsize())
    return sizes


def _gauge(name: str, text: str, value: float) -> Metric:
    return GaugeMetricFamily(name, text, value=value)
