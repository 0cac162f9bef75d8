"""The tables of docs/safety.md, made from the code: ``python -m tests.gate.safety_document`` prints them."""

import sys

from engine.permits import GateState, HoldReason
from engine.stages.gate import EventKind, next_state


def transition_table() -> str:
    """One row a state, one column a kind of event."""
    kinds = list(EventKind)
    head = [f"| from | {' | '.join(kinds)} |", "|---" * (len(kinds) + 1) + "|"]
    rows = [f"| **{state}** | {' | '.join(next_state(state, kind) for kind in kinds)} |" for state in GateState]
    return "\n".join(head + rows)


def reason_lists() -> str:
    """Which reasons clear by themselves, and which latch."""
    clearing = ", ".join(f"`{reason}`" for reason in HoldReason if not reason.is_fault)
    latching = ", ".join(f"`{reason}`" for reason in HoldReason if reason.is_fault)
    return (
        f"Clear by themselves, after a full dwell: {clearing}.\n\nLatch until a named person acknowledges: {latching}."
    )


if __name__ == "__main__":
    sys.stdout.write(f"{transition_table()}\n\n{reason_lists()}\n")
