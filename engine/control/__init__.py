"""The engine thread: reads a frame, measures it, decides, drives the beam line, and only then publishes.

Others submit commands to an :class:`EngineLoop`, read its bounded queues and its newest :class:`EngineStatus`, and
recover what a killed engine left in its journal.
"""

from engine.control.fraction_checks import (
    PositionState,
)
from engine.control.journal.format import (
    Entry,
    JournalFormatError,
    JournalHeader,
    RecoveredJournal,
    read_journal,
)
from engine.control.journal.journal import (
    ClientJournal,
    JournalError,
    OwnerJournal,
    TransitionJournal,
    boot_id,
)
from engine.control.loop import (
    EngineLoop,
)
from engine.control.outputs import FrameRecord, GateTransition, LiveView, LoopStatus
from engine.control.records import (
    EngineStatus,
)
from engine.control.turn_inputs import (
    MAX_WAIT_NS,
    URGENT,
    Command,
)

__all__ = [
    "MAX_WAIT_NS",
    "URGENT",
    "ClientJournal",
    "Command",
    "EngineLoop",
    "EngineStatus",
    "Entry",
    "FrameRecord",
    "GateTransition",
    "JournalError",
    "JournalFormatError",
    "JournalHeader",
    "LiveView",
    "LoopStatus",
    "OwnerJournal",
    "PositionState",
    "RecoveredJournal",
    "TransitionJournal",
    "boot_id",
    "read_journal",
]
