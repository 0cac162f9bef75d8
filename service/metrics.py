"""What a monitoring system reads at ``/metrics``: counts, times and states; no patient, no plan, no person.

Counters are :class:`service.tallies.Tallies` and :class:`service.http_tallies.HttpTallies`; states are read when
somebody asks, by :class:`service.engine_metrics.EngineMetrics` and :class:`service.machine_metrics.MachineMetrics`.
Nothing here is called by the engine's thread.
"""

from collections.abc import Iterable

from prometheus_client import GCCollector, ProcessCollector
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector, CollectorRegistry


class Metrics:
    """All counters and states, in the form that is asked for."""

    def __init__(self, registry: CollectorRegistry, collectors: Iterable[Collector]) -> None:
        self._registry = registry
        self.collectors: list[Collector] = []
        ProcessCollector(registry=registry)
        GCCollector(registry=registry)
        for one in collectors:
            self.add(one)

    def add(self, collector: Collector) -> None:
        """Ask one more."""
        self.collectors.append(collector)
        self._registry.register(collector)

    def text(self, accept: str = "") -> tuple[bytes, str]:
        """Write them all, as OpenMetrics where that is accepted; return the text and its media type."""
        write, media_type = choose_encoder(accept)
        return write(self._registry), media_type
