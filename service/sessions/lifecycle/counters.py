"""Prometheus counters over the life of the process; the session writer counts what it has written.

The times from hold to beam off, taken from the newest views as they are measured: each once, in order.
"""

from prometheus_client import CollectorRegistry, Counter, Histogram, disable_created_metrics

from engine.beam import BeamOff
from engine.control import FrameRecord, GateTransition, LiveView
from engine.core.clock import NS_PER_S
from engine.core.frames import MeasurementState
from engine.core.gate_state import GateState, HoldReason
from service.storage import audit
from service.storage.audit import Event
from service.storage.database import queries

MS_PER_S = 1000.0
LATENCY_BUCKETS_S = (0.005, 0.01, 0.02, 0.033, 0.05, 0.067, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0)
DECISION_BUCKETS_S = (0.001, 0.002, 0.003, 0.004, 0.006, 0.008, 0.01, 0.015, 0.02, 0.033, 0.05, 0.1)
HELD = frozenset({GateState.HOLD, GateState.FAULT})
LONGEST_STEP_S = 1.0
"""Longest time counted between two frames with the beam on [s]; across a longer gap the gate's limits held the beam."""


class SessionCounters:
    """Counters over the life of the process, across sessions."""

    def __init__(self) -> None:
        # The creation times of counters add nothing.
        disable_created_metrics()  # type: ignore[no-untyped-call]
        registry = self.registry = CollectorRegistry()
        self._frames = Counter("tidegate_frames", "Frames measured and written down", ["state"], registry=registry)
        self._missed = Counter(
            "tidegate_missed_frames", "Frames the camera counted and that never came", registry=registry
        )
        self._on = Counter("tidegate_line_on_frames", "Frames with the beam line on", registry=registry)
        on_text = "Time that the beam line was on, from frame to frame"
        self._on_s = Counter("tidegate_line_on_seconds", on_text, registry=registry)
        self._transitions = Counter(
            "tidegate_gate_transitions", "Changes of the gate", ["to_state", "reason"], registry=registry
        )
        holds_text = "Times that the gate began to hold, or to hold for another reason"
        self._holds = Counter("tidegate_holds", holds_text, ["reason"], registry=registry)
        off_text = "Times that a beam that was on was taken off"
        self._interruptions = Counter("tidegate_beam_interruptions", off_text, ["reason"], registry=registry)
        self._latency = _histogram(
            registry,
            "tidegate_latency_seconds",
            "From the camera's exposure to the command at the beam line",
            LATENCY_BUCKETS_S,
        )
        self._decision = _histogram(
            registry, "tidegate_decision_seconds", "From a frame in our hands to the gate's decision on it"
        )
        self._assertion = _histogram(
            registry, "tidegate_assertion_seconds", "From the gate's decision to the command at the beam line"
        )
        self._last: FrameRecord | None = None
        for state in MeasurementState:
            self._frames.labels(state=state.value)
        for reason in HoldReason:  # present from the start, or a rate would miss the first of each
            self._holds.labels(reason=reason.value)
            self._interruptions.labels(reason=reason.value)

    def frame(self, record: FrameRecord) -> None:
        """Count a frame that was written down."""
        self._frames.labels(state=record.measurement.state.value).inc()
        self._missed.inc(max(record.measurement.missed_frames, 0))
        self._decision.observe(max(record.decided_ns - record.received_ns, 0) / NS_PER_S)
        self._assertion.observe(max(record.asserted_ns - record.decided_ns, 0) / NS_PER_S)
        if record.latency_ms is not None:
            self._latency.observe(record.latency_ms / MS_PER_S)
        self._count_on(record)

    def _count_on(self, record: FrameRecord) -> None:
        last, self._last = self._last, record
        if record.line_on:
            self._on.inc()
        if last is not None and last.line_on:
            self._on_s.inc(min(max(record.decided_ns - last.decided_ns, 0) / NS_PER_S, LONGEST_STEP_S))

    def transition(self, transition: GateTransition) -> None:
        """Count a change of the gate."""
        reason = "" if transition.reason is None else transition.reason.value
        self._transitions.labels(to_state=transition.to_state.value, reason=reason).inc()
        if transition.to_state in HELD:
            self._holds.labels(reason=reason).inc()
        if transition.from_state is GateState.BEAM_ON and transition.to_state is not GateState.BEAM_ON:
            self._interruptions.labels(reason=reason).inc()


def _histogram(
    registry: CollectorRegistry, name: str, text: str, buckets_s: tuple[float, ...] = DECISION_BUCKETS_S
) -> Histogram:
    return Histogram(name, text, buckets=buckets_s, registry=registry)


class BeamOffs:
    """Takes the holds whose time to beam off was measured since the last call; one for each session.

    Attributes
    ----------
    missed
        Holds that were measured and not read in time.
    """

    def __init__(self) -> None:
        self._newest = 0
        self.missed = 0

    def take(self, view: LiveView | None) -> list[BeamOff]:
        """Return what is new in a view; empty where the accelerator's signal is no input."""
        if view is None or view.beam_on is None:
            return []
        found = [one for one in view.beam_on.newest_offs if one.number > self._newest]
        if found:
            self.missed += found[0].number - self._newest - 1
            self._newest = found[-1].number
        return found


def beam_off_event(session_id: str, off: BeamOff) -> Event:
    """Return the audit event of one hold, with the time of its end on the clock of the transitions."""
    detail = {"number": off.number, "held_ns": off.ended_ns, "off_ms": round(off.off_ms, 3)}
    return Event(actor=audit.SYSTEM, action=queries.BEAM_OFF, session_id=session_id, detail=detail)
