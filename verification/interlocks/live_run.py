"""Every interlock tripped once in an engine that runs, with the beam line in a process of its own.

The beam is really on before each. What is reported of it is what the line's own process wrote down.
"""

import contextlib
import math
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from engine.beam.compared_line import ComparedBeamLine
from engine.control.loop import EngineLoop
from engine.control.outputs import FrameRecord, GateTransition
from engine.core.breath import BreathEventKind
from engine.core.clock import NS_PER_MS, MonotonicClock
from engine.core.commands import Acknowledge, Arm
from engine.core.errors import BeamLineError, CommandRefusedError
from engine.core.frames import Measurement
from engine.core.gate_state import INTERLOCKS, GateState, HoldReason
from engine.gating.limits import GateLimits
from engine.gating.windows import amplitude_window
from engine.gating.windows.patient_breath import AWAY_S
from tests.support.control.loop_bench import drained
from tests.support.gating.streams import LEVEL_MM, PERIOD_NS
from verification.interlocks.far_line import Edge, FarLine, SpoiledAnswers, far_line
from verification.interlocks.live_camera import LiveCamera, LivePipeline, Mischief, wait_ns

LIMITS = GateLimits(
    window=amplitude_window(lower_mm=-5.0, upper_mm=5.0),
    dwell_ms=100.0,
    lease_ms=150.0,
    max_frame_age_ms=100.0,
    max_gap_ms=150.0,
    max_lag_ms=500.0,
    max_latency_ms=300.0,
    max_silence_ms=350.0,
    watchdog_ms=480.0,
    min_fps=14.0,
    operator_timeout_s=1.0,
    holding_events=frozenset({BreathEventKind.COUGH}),
)
"""As patient as a busy machine needs, and in such an order that each interlock is the first to see its own cause."""

SAMPLES_KEPT, TRANSITIONS_KEPT = 45, 24
STAYS_OFF_FRAMES = 8
TRIES = 8
"""A machine that is busy with other things may hold the beam for a reason of its own just then: look again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trip:
    """One interlock, how it is tripped, and how it is put right again.

    Attributes
    ----------
    act
        Trips it; may return when the cause was there [ns], where that is not at once.
    undo
        None where the cause goes by itself.
    limits
        What this trip needs otherwise; it then has a life and a line of its own, beside the others.
    """

    code: HoldReason
    how: str
    act: "Callable[[LiveRun], int | None]"
    undo: "Callable[[LiveRun], None] | None" = None
    limits: GateLimits = LIMITS
    ends_session: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What came of it; ``lease_end_ns`` is when the last permit before it had to lapse."""

    trip: Trip
    cause_ns: int
    off: Edge
    lease_end_ns: int
    back: str

    @property
    def off_after_ms(self) -> float:
        return (self.off.at_ns - self.cause_ns) / NS_PER_MS


class LiveRun:
    """One engine's life on a line; its queues are drained by a thread, as the service's writer does."""

    def __init__(self, line: FarLine, path: Path, limits: GateLimits) -> None:
        self.line = line
        self.clock = MonotonicClock()
        self.mischief = Mischief()
        self.pipeline = LivePipeline(self.clock, self.mischief)
        self.beam = SpoiledAnswers(path, self.clock, reply_ms=60.0)
        self.is_beam_stuck = False
        self.loop = EngineLoop(
            source=LiveCamera(self.clock, self.mischief),
            measurer=self.pipeline,
            learner=self.pipeline,
            beam=ComparedBeamLine(self.beam, self.clock, lambda: self.is_beam_stuck),
            limits=limits,
            clock=self.clock,
            sample_capacity=SAMPLES_KEPT,
            transition_capacity=TRANSITIONS_KEPT,
        )
        self.lease_ns = int(limits.lease_ms * NS_PER_MS)
        self.records: list[FrameRecord] = []
        self.transitions: list[GateTransition] = []
        self.learned_ns = 0
        self.is_present = self.is_recording = self.is_auditing = self.is_service_alive = True
        self._stop_requested = threading.Event()
        self._writer = threading.Thread(target=self._write, daemon=True)

    def __enter__(self) -> "LiveRun":
        self.loop.start()
        self._writer.start()
        return self

    def __exit__(self, *_: object) -> None:
        assert self.loop.stop(timeout_s=10.0)
        self._stop_requested.set()
        self._writer.join()

    def frames(self, count: int) -> None:
        """Let so many frames pass."""
        view = self.loop.status.view
        wanted = (0 if view is None else view.frames) + count
        while not self.loop.status.is_over and (self.loop.status.view is None or self.loop.status.view.frames < wanted):
            wait_ns(5 * NS_PER_MS)

    def turn_on(self) -> None:
        """Clear what is latched, arm, and wait until the line says that it is on."""
        for _ in range(TRIES):
            if self.line.is_on:
                return
            asked_ns = self.clock.now_ns()
            self.arm()
            if self.line.await_edge(is_on=True, after_ns=asked_ns, within_s=3.0) is not None:
                return
        raise AssertionError(f"the beam does not come on: {self.loop.gate.reason} {self.loop.gate.detail}")

    def arm(self) -> None:
        """Clear what is latched and arm, as far as a busy machine lets itself be asked."""
        with contextlib.suppress(CommandRefusedError, BeamLineError, TimeoutError):
            if self.loop.gate.reason is HoldReason.BEAM_ON_LIMIT:
                self.leave_window()
            if self.loop.gate.state is GateState.FAULT:
                self.loop.submit(Acknowledge(operator="bob")).result(timeout=5.0)
            if not self.loop.gate.is_armed:
                self.loop.submit(Arm(operator="ann")).result(timeout=5.0)

    def leave_window(self) -> None:
        """The signal is above the window for long enough to be a breath, as in the inhale."""
        self.mischief.spoil = _inhaled
        self.frames(math.ceil(AWAY_S * 1e9 / PERIOD_NS) + 3)
        self.mischief.spoil = None

    def has_reported(self, code: HoldReason, after_ns: int) -> bool:
        return any(change.reason is code and change.asserted_ns >= after_ns for change in list(self.transitions))

    def lease_end_ns(self, off: Edge) -> int:
        """When the last frame that was permitted before the line went off stopped to be worth anything."""
        records = [one for one in list(self.records) if one.gate_state is GateState.BEAM_ON]
        before = [one.received_ns for one in records if one.decided_ns <= off.at_ns]
        return (before[-1] if before else 0) + self.lease_ns

    def _write(self) -> None:
        while not self._stop_requested.wait(0.02):
            self._drain()
        self.is_recording = self.is_auditing = True
        self._drain()

    def _drain(self) -> None:
        drained(self.loop.notices)
        if self.is_service_alive:
            self.loop.note_service(self.clock.now_ns())
        if self.is_present:
            self.loop.note_presence("ann")
        if self.is_recording:
            self.records += drained(self.loop.samples)
        if self.is_auditing:
            self.transitions += drained(self.loop.transitions)


def _inhaled(frame: Measurement) -> Measurement:
    return replace(frame, motion=replace(frame.motion, whole_mm=LEVEL_MM + 3.6))


def run_all(folder: Path, trips: tuple[Trip, ...]) -> list[Outcome]:
    """Trip everything: what needs limits of its own beside the rest, what ends a session in a life of its own."""
    beside = [trip for trip in trips if trip.limits is not LIMITS]
    together = [trip for trip in trips if trip not in beside and not trip.ends_session]
    with ThreadPoolExecutor(max_workers=max(len(beside), 1)) as pool, far_line(folder / "line") as line:
        others = [pool.submit(_run_beside, folder, trip) for trip in beside]
        outcomes = [one for trip in trips if trip.ends_session for one in _run_life(line, folder / "line", [trip])]
        outcomes += _run_life(line, folder / "line", together)
        return outcomes + [one for other in others for one in other.result()]


NEVER_ON = {
    HoldReason.CALIBRATION_MISSING: ("a camera never calibrated is armed", replace(LIMITS, is_calibrated=False)),
    HoldReason.CAMERA_WARMING: ("a cold camera is armed", replace(LIMITS, warm_up_s=900.0)),
}
"""What is so from the first frame on."""


def is_ever_on(folder: Path, reason: HoldReason) -> bool:
    """Arm an engine that has one of `NEVER_ON`, and see whether its line ever goes on."""
    with far_line(folder / reason) as line:
        with LiveRun(line, folder / reason, NEVER_ON[reason][1]) as run:
            run.frames(3)
            while run.loop.gate.reason is not reason:  # a busy machine's own reasons pass
                run.arm()
                run.frames(3)
            run.frames(30)
        return any(edge.is_on for edge in line.edges)


def _run_beside(folder: Path, trip: Trip) -> list[Outcome]:
    path = folder / trip.code
    with far_line(path) as line:
        return _run_life(line, path, [trip])


def _run_life(line: FarLine, path: Path, trips: list[Trip]) -> list[Outcome]:
    with LiveRun(line, path, trips[0].limits) as run:
        run.frames(3)
        outcomes = [trip_once(run, trip) for trip in trips]
    return [replace(outcome, lease_end_ns=run.lease_end_ns(outcome.off)) for outcome in outcomes]


def trip_once(run: LiveRun, trip: Trip) -> Outcome:
    """Turn the beam on, trip the interlock, put it right, and see how the beam comes back."""
    for _ in range(TRIES):
        run.turn_on()
        run.frames(4)
        if not run.line.is_on:
            continue
        acted_ns = run.clock.now_ns()
        cause_ns = trip.act(run) or acted_ns
        off = run.line.await_edge(is_on=False, after_ns=cause_ns, within_s=6.0)
        if off is None:  # it had gone off for another reason just before
            assert not run.line.is_on, f"{trip.code}: the line stays on"
            _put_right(trip, run)
            continue
        is_reported = _is_reported(run, trip.code, cause_ns)
        back = _come_back(run, trip, off) if is_reported else _put_right(trip, run)
        if back:
            return Outcome(trip=trip, cause_ns=cause_ns, off=off, lease_end_ns=0, back=back)
    raise AssertionError(
        f"{trip.code} was not reported: {[(one.to_state, one.reason) for one in run.transitions[-6:]]}"
    )


def _is_reported(run: LiveRun, code: HoldReason, after_ns: int) -> bool:
    """Whether the interlock is named as the cause; while nothing is audited, the gate itself has to say so."""
    for _ in range(60):
        if run.has_reported(code, after_ns) or run.loop.gate.reason is code:
            return True
        wait_ns(10 * NS_PER_MS)
    return False


def _put_right(trip: Trip, run: LiveRun) -> str:
    """Something else took the beam off first: begin again."""
    if trip.undo is not None:
        trip.undo(run)
    return ""


def _come_back(run: LiveRun, trip: Trip, off: Edge) -> str:
    """Put it right; a fault stays off until somebody acknowledges and arms, a hold ends by itself after the dwell.

    Empty where a busy machine made something else of it.
    """
    if trip.ends_session:
        assert run.loop.join(timeout_s=10.0)
        return "in a new session"
    right_ns = run.clock.now_ns()
    _put_right(trip, run)
    if trip.code.is_fault or run.loop.gate.state is GateState.FAULT:
        run.frames(STAYS_OFF_FRAMES)  # an engine that hangs comes back first
        assert run.loop.gate.state is GateState.FAULT, trip.code
        assert run.line.await_edge(is_on=True, after_ns=off.at_ns, within_s=0.0) is None, trip.code
        run.turn_on()
        return "acknowledged and armed" if trip.code.is_fault else ""
    on = run.line.await_edge(is_on=True, after_ns=off.at_ns, within_s=5.0)
    if on is None:
        return ""
    if trip.undo is not None and on.at_ns < right_ns:
        return ""  # before it was put right: it was something else that took it off first
    assert on.at_ns - off.at_ns >= LIMITS.dwell_ms * NS_PER_MS, f"{trip.code}: the dwell was cut short"
    return "by itself, after the dwell"


def rows(outcomes: list[Outcome]) -> list[tuple[str, ...]]:
    """The table, one row an interlock in the order of the engine's own list."""
    order = {reason: number for number, reason in enumerate(INTERLOCKS)}
    return [
        (
            one.trip.code.value,
            "fault" if one.trip.code.is_fault else "hold",
            one.trip.how,
            one.off.kind,
            f"{one.off_after_ms:.0f}",
            one.back,
        )
        for one in sorted(outcomes, key=lambda one: order[one.trip.code])
    ]
