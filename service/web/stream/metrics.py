"""Metrics of the live stream."""

from collections.abc import Callable, Iterator
from typing import get_args

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from service.web.stream.counts import CLOSE_REASONS, StreamReading
from service.web.stream.query import Encoding, Form, Transport

KINDS = tuple(
    (transport, form.value, encoding.value)
    for transport in get_args(Transport)
    for form in Form
    for encoding in Encoding
    if transport == "websocket" or encoding is Encoding.JSON
)
"""All combinations of transport, form and encoding."""


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
        clients = GaugeMetricFamily(
            "tidegate_live_clients", "Clients of the live stream", labels=["transport", "form", "encoding"]
        )
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
