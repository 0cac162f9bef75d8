"""Runs a session again from its tape and its frames, and says whether the same came of it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from engine.beam.line import TroubleListener, tell_nobody
from engine.capture.source import SourceDescription
from engine.clock import ManualClock
from engine.errors import RecordingError
from engine.frames import RgbdFrame
from engine.loop import EngineLoop
from engine.permits import HoldReason, Lease
from engine.pipeline import Pipeline
from engine.replaying.head import RAW, TapeHead
from engine.replaying.outcomes import Row
from engine.replaying.pictures import Pictures
from engine.replaying.rehearing import Difference, Rehearing, RehearsalOver
from engine.replaying.spelling import Spelling
from engine.replaying.tape_file import Tape
from engine.replaying.witnessed_trainer import WitnessedTrainer
from engine.training import InlineTrainer
from engine.witness import WitnessedClock


@dataclass(frozen=True, slots=True, kw_only=True)
class Replay:
    """What came of a replay.

    Attributes
    ----------
    frames
        How many frames came out the same.
    transitions
        Every change of the gate that came out the same, as rows.
    elsewhere
        Those that another thread than the engine's had made: played back, not decided again.
    is_whole
        Whether the tape had its end; a killed session's has not.
    torn
        Why the tape ended early, where its writer knew.
    """

    frames: int
    transitions: list[Row]
    elsewhere: list[Row]
    difference: Difference | None
    is_whole: bool
    torn: str | None


class _NoLine:
    """A line that nothing is connected to: every answer of a line comes from the tape."""

    def __init__(self) -> None:
        self.on_trouble: TroubleListener = tell_nobody
        self.is_settling = False

    def open(self) -> None:
        """Open nothing."""

    def rearm(self) -> None:
        """Arm nothing."""

    def permit(self, _lease: Lease) -> None:
        """Permit nothing."""

    def hold(self, _reason: HoldReason) -> None:
        """Hold nothing."""

    def is_on(self) -> bool:
        """Answer no."""
        return False

    def close(self) -> None:
        """Close nothing."""


class _NoSource:
    """A source that is never asked."""

    def open(self) -> SourceDescription:
        """Refuse: the tape answers."""
        raise RehearsalOver

    def read(self, _timeout_s: float) -> RgbdFrame:
        """Refuse: the tape answers."""
        raise RehearsalOver

    def close(self) -> None:
        """Close nothing."""


def replay(
    tape: Tape,
    head: TapeHead,
    recording: Path,
    spelling: Spelling,
    *,
    on_frame: Callable[[int], None] = lambda _frames: None,
    on_told: Callable[[object], None] = lambda _outcome: None,
) -> Replay:
    """Run a session again, in the calling thread.

    ``on_frame`` hears how many frames came out the same so far, ``on_told`` every record and transition that is made.

    Raises
    ------
    RecordingError
        Tape or recording cannot be read.
    """
    number_of = (lambda frame: frame.index + 1) if head.frames.kind == RAW else (lambda frame: frame.device_index)
    pictures = Pictures(recording, number_of)
    try:
        rehearing = Rehearing(
            tape.turns(), spelling, pictures.frame, on_turn=lambda: on_frame(rehearing.frames), on_told=on_told
        )
        return _run(tape, head, rehearing)
    finally:
        pictures.close()


def _run(tape: Tape, head: TapeHead, rehearing: Rehearing) -> Replay:
    clock = ManualClock()  # never read: every reading comes from the tape
    pipeline = Pipeline(
        head.calibration,
        head.measuring,
        WitnessedClock(clock, rehearing),
        WitnessedTrainer(InlineTrainer(), rehearing),
    )
    try:
        if head.model is not None:
            pipeline.resume(head.model)
        loop = EngineLoop(
            source=_NoSource(), pipeline=pipeline, beam=_NoLine(), limits=head.limits, clock=clock, witness=rehearing
        )
        loop.run_here()
    except RehearsalOver:
        pass
    if rehearing.difference is None and rehearing.frames == 0 and not tape.is_whole:
        msg = f"the tape of session {head.session_id} holds nothing to replay"
        raise RecordingError(msg)
    return Replay(
        frames=rehearing.frames,
        transitions=rehearing.transitions,
        elsewhere=rehearing.elsewhere,
        difference=rehearing.difference,
        is_whole=tape.is_whole,
        torn=tape.torn,
    )
