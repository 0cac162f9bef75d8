"""The witness that writes down: what the engine's thread heard, a turn at a time, into a bounded queue.

Nothing here waits, and nothing here can hold a beam or let one be on. Where the queue is full the tape ends there, and
says so: the session is then replayed that far.
"""

import queue
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from engine.frames import RgbdFrame
from engine.live import GateTransition
from engine.replaying.heard import Raised, kept_of
from engine.witness import Seam

T = TypeVar("T")

TURNS_KEPT = 900
"""Half a minute, as of samples."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Turn:
    """What was heard from one frame's end to the next one's, and what came of it.

    Attributes
    ----------
    heard
        Each answer with where it came from, in order.
    told
        Records and transitions that the engine's thread made.
    elsewhere
        Transitions that another thread made: the watchdog's.
    """

    heard: list[tuple[Seam, Any]] = field(default_factory=list)
    told: list[object] = field(default_factory=list)
    elsewhere: list[GateTransition] = field(default_factory=list)


class Taping:
    """Writes a session's tape.

    Parameters
    ----------
    keep_frame
        Told of every frame that the engine got, once it is decided on; returns why the tape has to end before it, or
        None.
    """

    def __init__(
        self, *, turns_kept: int = TURNS_KEPT, keep_frame: Callable[[RgbdFrame], str | None] = lambda _frame: None
    ) -> None:
        self.turns: queue.Queue[Turn] = queue.Queue(turns_kept)
        self.torn: str | None = None
        self._over = threading.Event()
        self._keep_frame = keep_frame
        self._thread: int | None = threading.get_ident()  # an engine hears while it is put together
        self._turn = Turn()
        self._frame: RgbdFrame | None = None
        self._elsewhere: deque[GateTransition] = deque()

    def begin(self) -> None:
        """Take the calling thread for the engine's."""
        self._thread = threading.get_ident()

    def heard(self, seam: Seam, ask: Callable[[], T]) -> T:
        """Ask, and write the answer down if it is the engine's thread that asks."""
        if threading.get_ident() != self._thread:
            return ask()
        try:
            answer = ask()
        except Exception as error:
            self._turn.heard.append((seam, Raised(name=type(error).__name__, text=str(error))))
            raise
        self._turn.heard.append((seam, kept_of(seam, answer)))
        if isinstance(answer, RgbdFrame):
            self._frame = answer
        return answer

    def told(self, outcome: object) -> None:
        """Write down what came of it."""
        if threading.get_ident() == self._thread:
            self._turn.told.append(outcome)
        elif self.torn is None and isinstance(outcome, GateTransition):
            self._elsewhere.append(outcome)

    def turn(self) -> None:
        """Hand this turn over."""
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
        """Hand the last turn over."""
        self.turn()
        self._over.set()

    def _keep(self) -> None:
        """Leave the turn's frame where it is kept: now, for whoever writes it takes a core while the gate decides."""
        frame, self._frame = self._frame, None
        if frame is not None and self.torn is None:
            self.tear(self._keep_frame(frame))

    @property
    def is_over(self) -> bool:
        """Whether no turn comes any more."""
        return self._over.is_set()

    def await_news(self, timeout_s: float) -> None:
        """Wait a while, or until the session is over: for the thread that writes."""
        self._over.wait(timeout_s)

    def tear(self, why: str | None) -> None:
        """End the tape here, if there is a reason to; from any thread."""
        if why is not None and self.torn is None:
            self.torn = why
            self._thread = None  # nothing more is written down
