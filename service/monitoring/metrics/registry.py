"""The registry behind ``/metrics``: counts, durations and states, without patients, plans or persons.

Counters are :class:`service.sessions.lifecycle.counters.SessionCounters` and
:class:`service.monitoring.metrics.http.HttpCounters`. :class:`service.monitoring.metrics.engine.EngineMetrics` and
:class:`service.monitoring.metrics.machine.MachineMetrics` read the states at a scrape. The engine thread calls none of
them.

Request counts and durations by route template, so that invented paths create no time series.
"""

from collections.abc import Iterable

from prometheus_client import Counter, Gauge, GCCollector, Histogram, ProcessCollector
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector, CollectorRegistry

from service.access.request.rules import SOCKET, RuleTable

METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS", SOCKET})
OTHER_METHOD = "other"
NO_ROUTE = "unknown"
"""Route label of paths without a route."""
PAGE = "page"
"""Route label of the page's files."""
TIME_BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)


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


class HttpCounters:
    """Counters of HTTP requests and WebSockets since the start of the process."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self._requests = Counter(
            "tidegate_http_requests",
            "Answered requests",
            ["method", "route", "status"],
            registry=registry,
        )
        self._times = Histogram(
            "tidegate_http_request_duration_seconds",
            "Time from the request's head to the end of the answer",
            ["method", "route"],
            buckets=TIME_BUCKETS_S,
            registry=registry,
        )
        self._in_progress = Gauge("tidegate_http_requests_in_progress", "Requests in progress", registry=registry)
        self._sockets = Gauge("tidegate_http_sockets_open", "Open WebSockets", registry=registry)

    def begin(self, method: str) -> None:
        """Count the start of a request or WebSocket."""
        self._gauge(method).inc()

    def end(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count the end of a request or WebSocket; only requests count in the durations [s]."""
        self._gauge(method).dec()
        self._requests.labels(method=method, route=route, status=str(status)).inc()
        if method != SOCKET:
            self._times.labels(method=method, route=route).observe(seconds)

    def _gauge(self, method: str) -> Gauge:
        return self._sockets if method == SOCKET else self._in_progress


class RouteNames:
    """Maps paths to a fixed set of route labels."""

    def __init__(self, page_files: frozenset[str], table: RuleTable | None = None) -> None:
        self._page_files = page_files
        self._table = table or RuleTable()

    def of(self, path: str) -> str:
        """Return the route label of a path."""
        if path in self._page_files:
            return PAGE
        return next(iter(self._table.templates(path)), NO_ROUTE)


def method_of(scope_type: str, method: str) -> str:
    """Return the method label of a request."""
    if scope_type == "websocket":
        return SOCKET
    return method if method in METHODS else OTHER_METHOD
