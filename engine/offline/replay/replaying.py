"""Replays a session from its tape and its frames, and compares the outputs.

A survey of a tape, without replaying it.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine.beam.line import TroubleListener, ignore_trouble
from engine.capture.oni.reader import OniReader
from engine.capture.oni.streams import CodedFrame
from engine.capture.source import SourceDescription
from engine.control.loop import EngineLoop
from engine.core.clock import ManualClock
from engine.core.errors import RecordingError
from engine.core.frames import ColorImage, RgbdFrame
from engine.core.gate_state import HoldReason, Lease
from engine.core.input_tap import TappedClock
from engine.motion.learning.trainer import InlineTrainer
from engine.motion.pipeline import Pipeline
from engine.offline.replay.comparison import BIT_FOR_BIT, Comparison
from engine.offline.replay.encoding import FrameHead, TapeEncoding
from engine.offline.replay.header import RAW, TapeHeader
from engine.offline.replay.outcomes import Row, is_transition
from engine.offline.replay.recording_tap import TappedTrainer
from engine.offline.replay.replaying_tap import Difference, ReplayEnded, ReplayingTap
from engine.offline.replay.tape_file import Tape, read_tape

LOOK_AHEAD = 256
COLORS_KEPT = 64


# Finds a frame's pictures in a recording by the frame's entry on the tape; forward only, in the order of the frames.
#
# A depth picture is found by its number in the file, its colour picture by its time: of several with that time, the
# last one before the depth picture, because a raw recording is written in that order.
class Pictures:
    """The pictures of one recording.

    Parameters
    ----------
    number_of
        The number that a frame's depth picture has in this file.
    """

    def __init__(self, path: Path, number_of: Callable[[FrameHead], int]) -> None:
        self._reader = OniReader(path)
        self._coming: Iterator[CodedFrame] = self._reader.repeated_frames()  # as far as the session went
        self._number_of = number_of
        self._ahead: deque[CodedFrame] = deque()
        self._colors: deque[CodedFrame] = deque(maxlen=COLORS_KEPT)
        self._picture: tuple[CodedFrame, ColorImage] | None = None

    def frame(self, head: FrameHead) -> RgbdFrame:
        """Return the frame; raise RecordingError where the file does not hold it."""
        depth = self._depth(self._number_of(head))
        color = self._color(head.color_timestamp_us)
        if depth is None or depth.timestamp_us != head.timestamp_us or color is None:
            msg = f"{self._reader.name}: frame {head.index} of the session ({head.timestamp_us} us) is not in it"
            raise RecordingError(msg)
        return head.with_pictures(depth.decode_depth(), self._decoded(color))

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def _depth(self, number: int) -> CodedFrame | None:
        while True:
            coded = self._next()
            if coded is None or (coded.is_depth and coded.frame_id >= number):
                return coded if coded is not None and coded.frame_id == number else None
            if not coded.is_depth:
                self._colors.append(coded)

    def _color(self, timestamp_us: int) -> CodedFrame | None:
        before = next((one for one in reversed(self._colors) if one.timestamp_us == timestamp_us), None)
        return before or self._color_behind(timestamp_us)

    def _color_behind(self, timestamp_us: int) -> CodedFrame | None:
        while len(self._ahead) < LOOK_AHEAD and (coded := next(self._coming, None)) is not None:
            self._ahead.append(coded)
            if not coded.is_depth and coded.timestamp_us >= timestamp_us:
                break
        return next((one for one in self._ahead if not one.is_depth and one.timestamp_us == timestamp_us), None)

    def _next(self) -> CodedFrame | None:
        return self._ahead.popleft() if self._ahead else next(self._coming, None)

    def _decoded(self, color: CodedFrame) -> ColorImage:
        if self._picture is None or self._picture[0] is not color:
            self._picture = color, color.decode_color()
        return self._picture[1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Replay:
    """The result of a replay.

    Attributes
    ----------
    frames, identical_frames
        Number of frames with the same outputs, and of those that are the same to the last bit.
    transitions, recorded_transitions
        The gate's transitions that are the same, as rows: as replayed, and as recorded.
    elsewhere
        Transitions that another thread made: copied from the tape, not decided again.
    is_whole
        Whether the tape is complete; that of a killed session is not.
    torn
        Why the tape ends early, where its writer noted it.
    """

    frames: int
    identical_frames: int
    transitions: list[Row]
    recorded_transitions: list[Row]
    elsewhere: list[Row]
    difference: Difference | None
    is_whole: bool
    torn: str | None


class _NoLine:
    """A line without an output: every answer of the line comes from the tape."""

    def __init__(self) -> None:
        self.on_trouble: TroubleListener = ignore_trouble
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
    """A source that is never read: frames come from the tape."""

    def open(self) -> SourceDescription:
        """End the replay: the tape should have answered."""
        raise ReplayEnded

    def read(self, _timeout_s: float) -> RgbdFrame:
        """End the replay: the tape should have answered."""
        raise ReplayEnded

    def close(self) -> None:
        """Close nothing."""


def replay(
    tape: Tape,
    head: TapeHeader,
    recording: Path,
    encoding: TapeEncoding,
    *,
    comparison: Comparison = BIT_FOR_BIT,
    on_frame: Callable[[int], None] = lambda _frames: None,
    on_output: Callable[[object], None] = lambda _outcome: None,
) -> Replay:
    """Replay a session in the calling thread.

    ``comparison`` defines equality; ``on_frame`` is called with the number of frames that are the same so far,
    ``on_output`` with every record and transition that the replay makes.

    Raises
    ------
    RecordingError
        Tape or recording cannot be read.
    """
    number_of = (lambda frame: frame.index + 1) if head.frames.kind == RAW else (lambda frame: frame.device_index)
    pictures = Pictures(recording, number_of)
    try:
        tap = ReplayingTap(
            tape.turns(),
            encoding,
            pictures.frame,
            comparison=comparison,
            on_turn=lambda: on_frame(tap.frames),
            on_output=on_output,
        )
        return _run(tape, head, tap)
    finally:
        pictures.close()


def _run(tape: Tape, head: TapeHeader, tap: ReplayingTap) -> Replay:
    clock = ManualClock()  # never read: every reading comes from the tape
    pipeline = Pipeline(
        head.calibration,
        head.measuring,
        TappedClock(clock, tap),
        TappedTrainer(InlineTrainer(), tap),
        learns_after=True,
    )
    try:
        if head.model is not None:
            pipeline.learner.models.resume(head.model)
        if head.first_reference is not None:
            pipeline.learner.history.restore(head.first_reference)
        if head.plan_position is not None:
            pipeline.learner.history.restore_plan(head.plan_position)
        loop = EngineLoop(
            source=_NoSource(),
            measurer=pipeline,
            learner=pipeline.learner,
            beam=_NoLine(),
            limits=head.limits,
            clock=clock,
            tap=tap,
            fraction_arming=head.fraction_arming,
        )
        loop.run_here()
    except ReplayEnded:
        pass
    if tap.difference is None and tap.frames == 0 and not tape.is_whole:
        msg = f"the tape of session {head.session_id} holds nothing to replay"
        raise RecordingError(msg)
    return Replay(
        frames=tap.frames,
        identical_frames=tap.identical_frames,
        transitions=tap.transitions,
        recorded_transitions=tap.recorded_transitions,
        elsewhere=tap.elsewhere,
        difference=tap.difference,
        is_whole=tape.is_whole,
        torn=tape.torn,
    )


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
