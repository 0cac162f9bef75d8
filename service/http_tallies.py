"""Counts and times of requests, by the template of their route: what anybody can make up in a path makes no series."""

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from service.access.rules import SOCKET, RuleTable

METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS", SOCKET})
OTHER_METHOD = "other"
NO_ROUTE = "unknown"
"""Where every path is counted that is no route's."""
PAGE = "page"
"""Where the files of the page are counted."""
TIME_BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)


class HttpTallies:
    """Requests and sockets over the life of the process."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self._requests = Counter(
            "tidegate_http_requests",
            "Requests answered",
            ["method", "route", "status"],
            registry=registry,
        )
        self._times = Histogram(
            "tidegate_http_request_duration_seconds",
            "From a request's head to the end of its answer",
            ["method", "route"],
            buckets=TIME_BUCKETS_S,
            registry=registry,
        )
        self._under_way = Gauge("tidegate_http_requests_in_progress", "Requests being answered", registry=registry)
        self._sockets = Gauge("tidegate_http_sockets_open", "WebSockets that are open", registry=registry)

    def begin(self, method: str) -> None:
        """Count one that has come."""
        self._gauge(method).inc()

    def end(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count one that was answered; a socket's time is no answer's."""
        self._gauge(method).dec()
        self._requests.labels(method=method, route=route, status=str(status)).inc()
        if method != SOCKET:
            self._times.labels(method=method, route=route).observe(seconds)

    def _gauge(self, method: str) -> Gauge:
        return self._sockets if method == SOCKET else self._under_way


class RouteNames:
    """Tells what a request is counted under: a few words that no caller can add to."""

    def __init__(self, page_files: frozenset[str], table: RuleTable | None = None) -> None:
        self._page_files = page_files
        self._table = table or RuleTable()

    def of(self, path: str) -> str:
        """Return the template of a path."""
        if path in self._page_files:
            return PAGE
        return next(iter(self._table.templates(path)), NO_ROUTE)


def method_of(scope_type: str, method: str) -> str:
    """Return what a method is counted under."""
    if scope_type == "websocket":
        return SOCKET
    return method if method in METHODS else OTHER_METHOD
