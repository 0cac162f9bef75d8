"""A survey of a tape, without replaying it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine.offline.replay.outcomes import is_transition
from engine.offline.replay.tape_file import read_tape


@dataclass(frozen=True, slots=True, kw_only=True)
class Survey:
    """Number of frames and of transitions, noted facts, and how the tape ends."""

    frames: int
    transitions: int
    facts: dict[str, Any]
    is_whole: bool
    torn: str | None


def survey(path: Path) -> Survey:
    """Read a tape through; raise RecordingError where it is not a tape, or damaged."""
    tape = read_tape(path)
    frames = transitions = 0
    for turn in tape.turns():
        changes = sum(is_transition(row) for row in turn.rows)
        transitions += changes + len(turn.elsewhere)
        frames += len(turn.rows) - changes
    return Survey(frames=frames, transitions=transitions, facts=tape.facts, is_whole=tape.is_whole, torn=tape.torn)
