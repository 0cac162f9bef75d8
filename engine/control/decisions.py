"""One decision of the gate as a value: what it was made on, the gate before and after it, and when."""

from dataclasses import dataclass

from engine.core.frames import Measurement, RgbdFrame
from engine.gating.gate import Gate


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cause:
    """What a decision is made on: a frame with its measurement, an operator's command, or neither.

    A cause with a ``detail`` is recorded as a transition even where the gate's state stays.
    """

    frame: RgbdFrame | None = None
    measurement: Measurement | None = None
    operator: str | None = None
    detail: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Decision:
    """A decision that was taken, or that the line is about to carry out.

    Attributes
    ----------
    decided_ns, asserted_ns
        When the gate had decided, and when the line had carried it out [ns, host monotonic]; equal before the line
        was asked.
    captured_ns
        When the camera took the frame [ns, host monotonic]; None without a frame.
    operator_holds
        All who hold the beam by hand, in the order of their holds.
    holder
        The first of them, or the one whose hold waits in the command queue.
    """

    cause: Cause
    before: Gate
    gate: Gate
    decided_ns: int
    asserted_ns: int
    captured_ns: int | None
    operator_holds: tuple[str, ...] = ()
    holder: str | None = None

    @property
    def is_change(self) -> bool:
        """Whether the gate's state or its reason changed."""
        return (self.gate.state, self.gate.reason) != (self.before.state, self.before.reason)
