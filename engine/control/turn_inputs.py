"""What the engine thread reads in one turn, as values (ADR 0016).

A turn reads one :class:`TurnInputs`, one :class:`CommandInputs` for each command, at most one :class:`FrameInput`, and
for each decision one :class:`engine.gating.interlocks.DecisionInputs` and a :class:`LineAnswer` for each order to the
line. Tapes omit defaults, so they must never change.
"""

from dataclasses import dataclass

from engine.control.command_queue import QueuedCommand
from engine.core.frames import RgbdFrame
from engine.core.gate_state import HoldReason


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TurnInputs:
    """Read at the start of a turn: whether the engine is to stop, and the commands that wait. A stop takes none."""

    is_stop_requested: bool = False
    commands: tuple[QueuedCommand, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandInputs:
    """Read when a command's turn has come.

    Attributes
    ----------
    is_wanted
        Whether the caller still waits for the answer.
    is_watchdog_running
        Whether the watchdog's thread is alive.
    queue_trouble
        Why a queue to the disk stands against the beam.
    operator_absence
        That no person who may arm is present, for a program that arms; empty otherwise.
    """

    is_wanted: bool = True
    is_watchdog_running: bool = True
    queue_trouble: HoldReason | None = None
    operator_absence: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameInput:
    """The source's answer: a frame, or none in time.

    Attributes
    ----------
    away
        Why the camera delivers none; None where it was only too late.
    at_ns
        When the source answered [ns, host monotonic].
    """

    frame: RgbdFrame | None = None
    away: str | None = None
    at_ns: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LineAnswer:
    """The beam line's answer to one order.

    Attributes
    ----------
    is_on
        As read back after the order; True where it was not, since the line may be on.
    is_settling
        Whether the order may not have taken effect yet.
    error
        What the line raised.
    watchdog_fired
        Whether the watchdog has held the line: then that is why it refuses a permit.
    at_ns
        When the line had answered [ns, host monotonic].
    """

    is_on: bool = True
    is_settling: bool = False
    error: Exception | None = None
    watchdog_fired: bool = False
    at_ns: int
