"""Gate transitions for journals."""

from dataclasses import replace

from engine.control.outputs import GateTransition
from engine.core.gate_state import GateState


def transition(at_ns: int = 7, **changes: object) -> GateTransition:
    made = GateTransition(
        at_ns=at_ns,
        frame_index=3,
        from_state=GateState.DWELL,
        to_state=GateState.BEAM_ON,
        reason=None,
        operator=None,
        detail="",
        captured_us=None,
        received_ns=5,
        decided_ns=at_ns,
        asserted_ns=at_ns,
    )
    return replace(made, **changes)
