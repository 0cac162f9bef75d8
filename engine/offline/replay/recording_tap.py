"""The input tap that records: what the engine thread read, one turn at a time, into a bounded queue.

Nothing here waits, and nothing here affects the beam. Where the queue is full the tape ends there, with the reason: the
session can be replayed up to that turn.

A trainer behind the input tap: the frame at which a result arrives depends on a thread, the result does not.
"""

import queue
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from engine.control.outputs import GateTransition
from engine.control.turn_inputs import FrameInput
from engine.core.errors import ModelError
from engine.core.frames import RgbdFrame
from engine.core.input_tap import InputKind, InputTap
from engine.motion.learning.trainer import Trainer
from engine.offline.replay.encoding import kept_of, raised_of

T = TypeVar("T")

TURNS_KEPT = 900
"""Half a minute, as of samples."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Turn:
    """What was read from the end of one frame to the end of the next, and the outputs.

    Attributes
    ----------
    observed
        Each reading with its kind, in order.
    emitted
        Records and transitions that the engine thread made.
    elsewhere
        Transitions that another thread made: the watchdog's.
    """

    observed: list[tuple[InputKind, Any]] = field(default_factory=list)
    emitted: list[object] = field(default_factory=list)
    elsewhere: list[GateTransition] = field(default_factory=list)


class RecordingTap:
    """Records a session.

    Parameters
    ----------
    keep_frame
        Called with every frame that the engine read, once it is decided on; returns why the tape has to end before it,
        or None.
    """

    def __init__(
        self, *, turns_kept: int = TURNS_KEPT, keep_frame: Callable[[RgbdFrame], str | None] = lambda _frame: None
    ) -> None:
        self.turns: queue.Queue[Turn] = queue.Queue(turns_kept)
        self.torn: str | None = None
        self._over = threading.Event()
        self._keep_frame = keep_frame
        self._thread: int | None = threading.get_ident()  # an engine reads the clock while it is constructed
        self._turn = Turn()
        self._frame: RgbdFrame | None = None
        self._elsewhere: deque[GateTransition] = deque()

    def begin(self) -> None:
        """Make the calling thread the engine thread."""
        self._thread = threading.get_ident()

    def observe(self, kind: InputKind, read: Callable[[], T]) -> T:
        """Read, and record the reading if the engine thread reads."""
        if threading.get_ident() != self._thread:
            return read()
        try:
            answer = read()
        except Exception as error:
            self._turn.observed.append((kind, raised_of(error)))
            raise
        self._turn.observed.append((kind, kept_of(kind, answer)))
        if isinstance(answer, FrameInput):
            self._frame = answer.frame
        return answer

    def emit(self, outcome: object) -> None:
        """Record an output."""
        if threading.get_ident() == self._thread:
            self._turn.emitted.append(outcome)
        elif self.torn is None and isinstance(outcome, GateTransition):
            self._elsewhere.append(outcome)

    def turn(self) -> None:
        """Queue this turn for the writer."""
        turn, self._turn = self._turn, Turn()
        while self._elsewhere:
            turn.elsewhere.append(self._elsewhere.popleft())
        self._keep()
        if self.torn is not None:
            return
        try:
            self.turns.put_nowait(turn)
        except queue.Full:
            self.tear("the tape could not be written down in time")

    def end(self) -> None:
        """Queue the last turn for the writer."""
        self.turn()
        self._over.set()

    def _keep(self) -> None:
        """Keep the turn's frame: only now, because writing it takes a core that the gate's decision needs."""
        frame, self._frame = self._frame, None
        if frame is not None and self.torn is None:
            self.tear(self._keep_frame(frame))

    @property
    def is_over(self) -> bool:
        """Whether the last turn was queued."""
        return self._over.is_set()

    def await_end(self, timeout_s: float) -> None:
        """Wait for ``timeout_s``, or until the session is over; called by the writer's thread."""
        self._over.wait(timeout_s)

    def tear(self, why: str | None) -> None:
        """End the tape here, if ``why`` is a reason to; from any thread."""
        if why is not None and self.torn is None:
            self.torn = why
            self._thread = None  # nothing more is recorded


class TappedTrainer(Generic[T]):
    """Wraps a trainer, and has the tap observe when a result arrives."""

    def __init__(self, trainer: Trainer[T], tap: InputTap) -> None:
        self._trainer, self._tap = trainer, tap

    def start(self, job: Callable[[], T]) -> None:
        """Begin a job."""
        self._trainer.start(job)

    @property
    def is_busy(self) -> bool:
        """Whether a job was started and its result not yet collected."""
        return self._trainer.is_busy

    def collect(self) -> T | ModelError | None:
        """Return a finished job's result or failure once, without waiting."""
        return self._tap.observe(InputKind.TRAINED, self._trainer.collect)
