"""Counters over the life of the process, fed by the writer's thread as frames are written down."""

from prometheus_client import CollectorRegistry, Counter, Histogram, disable_created_metrics

from engine.frames import MeasurementState
from engine.live import FrameRecord, GateTransition

MS_PER_S = 1000.0
LATENCY_BUCKETS_S = (0.005, 0.01, 0.02, 0.033, 0.05, 0.067, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0)


class Tallies:
    """Counters over the life of the process, across sessions."""

    def __init__(self) -> None:
        # When a counter began says nothing that the counter does not.
        disable_created_metrics()  # type: ignore[no-untyped-call]
        self.registry = CollectorRegistry()
        self._frames = Counter("tidegate_frames", "Frames measured and written down", ["state"], registry=self.registry)
        self._missed = Counter(
            "tidegate_missed_frames", "Frames the camera counted and that never came", registry=self.registry
        )
        self._on = Counter("tidegate_line_on_frames", "Frames with the beam line on", registry=self.registry)
        self._transitions = Counter(
            "tidegate_gate_transitions", "Changes of the gate", ["to_state", "reason"], registry=self.registry
        )
        self._latency = Histogram(
            "tidegate_latency_seconds",
            "From the camera taking a frame to the beam line told",
            buckets=LATENCY_BUCKETS_S,
            registry=self.registry,
        )
        for state in MeasurementState:
            self._frames.labels(state=state.value)

    def frame(self, record: FrameRecord) -> None:
        """Count a frame that was written down."""
        self._frames.labels(state=record.measurement.state.value).inc()
        self._missed.inc(max(record.measurement.missed_frames, 0))
        if record.line_on:
            self._on.inc()
        if record.latency_ms is not None:
            self._latency.observe(record.latency_ms / MS_PER_S)

    def transition(self, transition: GateTransition) -> None:
        """Count a change of the gate."""
        reason = "" if transition.reason is None else transition.reason.value
        self._transitions.labels(to_state=transition.to_state.value, reason=reason).inc()
