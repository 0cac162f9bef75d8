"""The registry behind ``/metrics``: counts, durations and states, without patients, plans or persons.

Counters are :class:`service.sessions.lifecycle.counters.SessionCounters` and
:class:`service.monitoring.metrics.http.HttpCounters`. :class:`service.monitoring.metrics.engine.EngineMetrics` and
:class:`service.monitoring.metrics.machine.MachineMetrics` read the states at a scrape. The engine thread calls none of
them.
"""

from collections.abc import Iterable

from prometheus_client import GCCollector, ProcessCollector
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector, CollectorRegistry


class Metrics:
    """All counters and states, in the requested format."""

    def __init__(self, registry: CollectorRegistry, collectors: Iterable[Collector]) -> None:
        self._registry = registry
        self.collectors: list[Collector] = []
        ProcessCollector(registry=registry)
        GCCollector(registry=registry)
        for one in collectors:
            self.add(one)

    def add(self, collector: Collector) -> None:
        """Register a collector."""
        self.collectors.append(collector)
        self._registry.register(collector)

    def text(self, accept: str = "") -> tuple[bytes, str]:
        """Return all metrics and their media type; OpenMetrics if ``accept`` permits it, else Prometheus text."""
        write, media_type = choose_encoder(accept)
        return write(self._registry), media_type
