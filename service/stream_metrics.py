"""What a monitoring system reads about the live stream: who watches, and what was left out for whom."""

from collections.abc import Callable, Iterator
from typing import get_args

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from service.stream.asking import Encoding, Form, Transport
from service.stream.counts import WHYS, StreamReading

KINDS = tuple(
    (transport, form.value, encoding.value)
    for transport in get_args(Transport)
    for form in Form
    for encoding in Encoding
    if transport == "websocket" or encoding is Encoding.JSON
)
"""Every kind of client that there can be."""


class StreamMetrics(Collector):
    """The stream's own reading, when asked."""

    def __init__(self, read: Callable[[], StreamReading]) -> None:
        self._read = read

    def describe(self) -> list[Metric]:
        """Name nothing beforehand, as the other collectors."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Read how the stream stands."""
        reading = self._read()
        clients = GaugeMetricFamily(
            "tidegate_live_clients", "Clients of the live stream", labels=["transport", "form", "encoding"]
        )
        for kind in KINDS:
            clients.add_metric(kind, reading.clients.get(kind, 0))
        yield clients
        yield CounterMetricFamily("tidegate_live_messages", "Messages sent to all clients together", value=reading.sent)
        yield CounterMetricFamily(
            "tidegate_live_encoded", "Messages written, once for each form that somebody wants", value=reading.encoded
        )
        yield CounterMetricFamily(
            "tidegate_live_skipped", "Samples left out because a client took too long", value=reading.skipped
        )
        closed = CounterMetricFamily("tidegate_live_closed", "Clients that are none any more", labels=["why"])
        for why in WHYS:
            closed.add_metric([why], reading.closed.get(why, 0))
        yield closed
