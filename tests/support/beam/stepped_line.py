"""A wired line without threads, on a clock that only the test moves: one millisecond at a time, in their order."""

from collections.abc import Callable

from engine.beam.wire.line_supervisor import WATCH_MS, LineTimes
from engine.beam.wire.supervised_line import WiredBeamLine
from engine.core.clock import ManualClock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease

MS = 1_000_000


class HeldInTimeError(BaseException):
    """The story is reported up to its end in the middle of an exchange."""


class ScriptedWire:
    """A receiver whose contact does ``lag_ms`` later what it was sent, and whose answers take ``answer_ms``."""

    name = "the scripted line"

    def __init__(self, world: "World", *, answer_ms: int = 3, lag_ms: int = 0) -> None:
        self.world, self.answer_ms, self.lag_ms = world, answer_ms, lag_ms
        self.is_silent = self.is_refusing = False
        self.stuck: bool | None = None
        self.commands: list[tuple[int, bool, int]] = []
        self.changes: list[tuple[int, bool]] = []
        self.connects = self.closes = 0

    def connect(self) -> None:
        self.connects += 1
        if self.is_refusing:
            raise OSError("refused")

    def exchange(self, *, is_on: bool, heartbeat: int, within_s: float) -> bool:
        if self.is_refusing:
            raise OSError("reset by peer")
        if self.is_silent:
            self.world.pass_ms(round(within_s * 1000) + 400)
            raise OSError("timed out")
        now_ns = self.world.clock.now_ns()
        self.commands.append((now_ns, is_on, heartbeat))
        if is_on is not self._at(10**18):
            self.changes.append((now_ns + self.lag_ms * MS, is_on))
        self.world.pass_ms(self.answer_ms)
        if self.is_silent:
            raise OSError("timed out")
        return self._at(self.world.clock.now_ns()) if self.stuck is None else self.stuck

    def _at(self, now_ns: int) -> bool:
        reached = [is_on for at_ns, is_on in self.changes if at_ns <= now_ns]
        return reached[-1] if reached else False

    def close(self) -> None:
        self.closes += 1

    @property
    def commands_on(self) -> bool:
        return self.commands[-1][1]


class SteppedLine(WiredBeamLine):
    """Its threads are the world's loops."""

    def _start_threads(self) -> None:
        """None: the world steps it."""


class World:
    """A clock, a wire and a line; ``acts`` happen at their millisecond, also in the middle of an exchange."""

    def __init__(self, times: LineTimes | None = None, **wire: int) -> None:
        self.clock = ManualClock(10_000 * MS)
        self.start_ns = self.clock.now_ns()
        self.wire = ScriptedWire(self, **wire)
        self.line = SteppedLine(self.wire, self.clock, times)
        self.troubles: list[tuple[int, HoldReason, str]] = []
        self.line.on_trouble = lambda reason, detail: self.troubles.append((self.now_ms, reason, detail))
        self.acts: dict[int, list[Callable[[], None]]] = {}
        self.sequence = 0
        self._ends_ms = 10**9

    @property
    def now_ms(self) -> int:
        return (self.clock.now_ns() - self.start_ns) // MS

    def opened(self) -> "World":
        """Open, and arm as soon as the line may be."""
        self.line.open()
        self.run(to_ms=self.now_ms + 3 * (20 + self.wire.answer_ms))
        self.line.rearm()
        return self

    def at(self, ms: int, *acts: Callable[[], None]) -> None:
        self.acts.setdefault(ms, []).extend(acts)

    def permit(self, length_ms: int = 80) -> None:
        now_ns = self.clock.now_ns()
        self.sequence += 1
        self.line.permit(Lease(granted_ns=now_ns, expires_ns=now_ns + length_ms * MS, sequence=self.sequence))

    def hold(self) -> None:
        self.line.hold(HoldReason.OUTSIDE_WINDOW)

    def permit_each_frame(self, from_ms: int, to_ms: int) -> None:
        """Renew as the engine does; a refusal is no error here."""
        for ms in range(from_ms, to_ms, 33):
            self.at(ms, self._try_permit)

    def _try_permit(self) -> None:
        try:
            self.permit()
        except BeamLineError:
            return

    def pass_ms(self, length_ms: int) -> None:
        for _ in range(length_ms):
            self.clock.advance_ns(MS)
            for act in self.acts.pop(self.now_ms, []):
                act()
            if self.now_ms % round(WATCH_MS) == 0:
                self.line.watch_once()
            if self.now_ms >= self._ends_ms:
                raise HeldInTimeError

    def run(self, *, to_ms: int) -> "World":
        """Be the exchanger: exchange, then rest until the next cycle, the lease's end or the bell."""
        self._ends_ms = to_ms
        try:
            while True:
                self.line.exchange_once()
                self._rest()
        except HeldInTimeError:
            self._ends_ms = 10**9
            return self

    def _rest(self) -> None:
        for _ in range(-(-self.line.rest_ns() // MS)):
            if not self.line._wakeups.empty():
                break
            self.pass_ms(1)
        while not self.line._wakeups.empty():
            self.line._wakeups.get_nowait()
