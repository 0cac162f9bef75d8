"""Counters of the live stream, and the metrics made from them."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from service.web.stream.encoding import Form, Transport

CloseReason = Literal["gone", "stalled", "not_logged_in", "chatty", "full", "failed", "leaving"]
"""Why a client's connection ended; ``full``: it was refused. Values are sent to clients and used as metric labels."""
CLOSE_REASONS: tuple[CloseReason, ...] = ("gone", "stalled", "not_logged_in", "chatty", "full", "failed", "leaving")
KINDS = tuple((transport, form.value) for transport in get_args(Transport) for form in Form)
"""All combinations of transport and form."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamReading:
    """Connected clients, and totals since the start.

    Attributes
    ----------
    clients
        Connected clients by transport and form.
    sent
        Messages sent to all clients.
    skipped
        Samples dropped because a client was too slow.
    closed
        Ended connections by reason.
    encoded
        Encoded messages: one per shape, shared by all clients of that shape.
    """

    clients: Mapping[tuple[str, str], int]
    sent: int
    skipped: int
    closed: Mapping[str, int]
    encoded: int

    @property
    def refused(self) -> int:
        """Clients refused because the stream was full."""
        return self.closed.get("full", 0)


@dataclass(slots=True)
class StreamCounts:
    """Counters; used by the event loop only."""

    sent: int = 0
    skipped: int = 0
    closed: Counter[CloseReason] = field(default_factory=Counter)


class StreamMetrics(Collector):
    """Collects the stream's counters at each scrape."""

    def __init__(self, read: Callable[[], StreamReading]) -> None:
        self._read = read

    def describe(self) -> list[Metric]:
        """Declare no metrics in advance, like the other collectors."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics."""
        reading = self._read()
        clients = GaugeMetricFamily("tidegate_live_clients", "Clients of the live stream", labels=["transport", "form"])
        for kind in KINDS:
            clients.add_metric(kind, reading.clients.get(kind, 0))
        yield clients
        yield CounterMetricFamily("tidegate_live_messages", "Messages sent to all clients together", value=reading.sent)
        yield CounterMetricFamily(
            "tidegate_live_encoded", "Messages encoded, once per requested form", value=reading.encoded
        )
        yield CounterMetricFamily(
            "tidegate_live_skipped", "Samples dropped because a client was too slow", value=reading.skipped
        )
        closed = CounterMetricFamily("tidegate_live_closed", "Connections that ended", labels=["why"])
        for why in CLOSE_REASONS:
            closed.add_metric([why], reading.closed.get(why, 0))
        yield closed
