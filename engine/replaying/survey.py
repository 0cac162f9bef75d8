"""What a tape holds, told before it is replayed."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine.replaying.outcomes import is_transition
from engine.replaying.tape_file import read_tape


@dataclass(frozen=True, slots=True, kw_only=True)
class Survey:
    """How many frames and changes of the gate there are, what else was noted, and how it ends."""

    frames: int
    transitions: int
    facts: dict[str, Any]
    is_whole: bool
    torn: str | None


def survey(path: Path) -> Survey:
    """Read a tape through; raise RecordingError where it is none, or is damaged."""
    tape = read_tape(path)
    frames = transitions = 0
    for turn in tape.turns():
        told = sum(is_transition(row) for row in turn.rows)
        transitions += told + len(turn.elsewhere)
        frames += len(turn.rows) - told
    return Survey(frames=frames, transitions=transitions, facts=tape.facts, is_whole=tape.is_whole, torn=tape.torn)
