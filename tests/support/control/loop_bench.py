"""A scripted source, a pipeline that measures what it is sent, and lines that fail: enough to run the real loop."""

import queue
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from typing import TypeVar

import numpy as np

from engine.beam.simulated import SimulatedBeamLine
from engine.capture.source import SourceDescription
from engine.control.beam_driver import BeamDriver, LineOrders
from engine.control.loop import EngineLoop
from engine.control.outputs import FrameRecord, GateTransition
from engine.control.turn_inputs import Command
from engine.control.watchdog import Watchdog
from engine.core.breath import WHOLE, SignalChoice
from engine.core.clock import Clock, ManualClock
from engine.core.errors import FrameTimeoutError, SourceEndedError
from engine.core.fraction_arming import FractionArming
from engine.core.frames import FloatArray, Measurement, MeasurementState, RgbdFrame
from engine.core.gate_state import HoldReason, Lease
from engine.core.learning_status import LearningEvent, LearningStatus
from engine.core.motion_model import MotionModel
from engine.core.position_check import PositionCheck
from engine.core.reference import ReferenceDistance, ReferenceMoment, ReferenceProposal
from engine.core.signals import LearnedLevels, LearnedRange, Ranges
from engine.gating.gate import GateLimits
from engine.motion.tracking.repeated_pictures import RepeatedPictures
from tests.support.gating.streams import LEVEL_MM, LIMITS, MEASURING_NS, MS, PERIOD_NS, START_NS, measured

DEPTH = np.full((4, 6), 850, dtype=np.uint16)
COLOR = np.full((4, 6, 3), 90, dtype=np.uint8)
DESCRIPTION = SourceDescription(
    kind="script", name="test", depth_size=(6, 4), color_size=(6, 4), fps=29.97, is_live=False
)
T = TypeVar("T")


def depth_picture(index: int) -> np.ndarray:
    """A picture unlike the one before it, as a real sensor's always is."""
    picture = DEPTH.copy()
    picture[0, 0] += index % 100
    return picture


def color_picture(index: int) -> np.ndarray:
    picture = COLOR.copy()
    picture[0, 0] += index % 100
    return picture


Step = Callable[["ScriptedSource", float], RgbdFrame]


class ScriptedSource:
    """Runs one step of its script a read, on a clock that only it moves; the end of the script is the end."""

    def __init__(self, clock: ManualClock, script: Sequence[Step]) -> None:
        self.clock = clock
        self.script = list(script)
        self.frames = 0
        self.opened = self.closed = 0
        self.beam: SimulatedBeamLine | None = None
        self.line_was_on_at_close: bool | None = None
        self.on_read: Callable[[], None] = lambda: None

    def open(self) -> SourceDescription:
        self.opened += 1
        return DESCRIPTION

    def read(self, timeout_s: float) -> RgbdFrame:
        self.on_read()
        if not self.script:
            raise SourceEndedError("the script is over")
        return self.script.pop(0)(self, timeout_s)

    def close(self) -> None:
        self.closed += 1
        self.line_was_on_at_close = None if self.beam is None else self.beam.is_on()

    def frame(self, *, missed_frames: int = 0) -> RgbdFrame:
        index = self.frames
        self.frames += 1
        return RgbdFrame(
            index=index,
            device_index=index,
            missed_frames=missed_frames,
            timestamp_us=self.clock.now_ns() // 1_000,
            color_timestamp_us=self.clock.now_ns() // 1_000,
            received_ns=self.clock.now_ns(),
            queue_empty_ns=self.clock.now_ns(),
            depth_mm=depth_picture(index),
            color=color_picture(index),
        )


def good(source: ScriptedSource, _timeout_s: float) -> RgbdFrame:
    source.clock.advance_ns(PERIOD_NS - MEASURING_NS)
    return source.frame()


def silent(source: ScriptedSource, timeout_s: float) -> RgbdFrame:
    source.clock.advance_ns(round(timeout_s * 1e9))
    raise FrameTimeoutError("nothing came")


def raising(error: BaseException) -> Step:
    def step(_source: ScriptedSource, _timeout_s: float) -> RgbdFrame:
        raise error

    return step


def after(act: Callable[[], object]) -> Step:
    """Do something between two frames, then deliver the next."""

    def step(source: ScriptedSource, timeout_s: float) -> RgbdFrame:
        act()
        return good(source, timeout_s)

    return step


class RecordingPipeline:
    """Measures every new picture as good unless asked to spoil it; takes MEASURING_NS of the manual clock."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.repeated = RepeatedPictures()
        self.spoil: dict[int, Callable[[Measurement], Measurement]] = {}
        self.model: MotionModel | None = object()  # type: ignore[assignment]
        self.model_shortcoming: str | None = None
        self.model_generation = 1
        self.has_reference = True
        self.is_model_waiting = False
        self.notices: list[LearningEvent] = []
        self.was_kept: list[bool] = []
        self.ranges: Ranges = {WHOLE: LearnedRange(low=LEVEL_MM, high=LEVEL_MM + 10.0)}
        self.proposals: tuple[ReferenceProposal, ...] = ()
        self.moments: list[ReferenceMoment] = []
        self.most_mm: list[float | None] = []
        self.distance_of_next: ReferenceDistance | None = None
        self.distance: ReferenceDistance | None = None
        self.is_position_required = False
        self.position_check: PositionCheck | None = None
        self.surface_mm: FloatArray | None = None
        self.zero_number = 1
        self.calls: list[str] = []
        self.trouble: Exception | None = None
        self.after_decision: Callable[[], None] = lambda: None

    def measure(self, frame: RgbdFrame) -> Measurement:
        if isinstance(self.clock, ManualClock):
            self.clock.advance_ns(MEASURING_NS)
        good_frame = replace(
            measured(frame.index),
            timestamp_us=frame.timestamp_us,
            received_ns=frame.received_ns,
            queue_empty_ns=frame.queue_empty_ns,
            missed_frames=frame.missed_frames,
            measured_ns=self.clock.now_ns(),
        )
        old = self.repeated.check(frame)
        if old is not None:
            return replace(good_frame, state=MeasurementState.LOST, lost=old, motion=None)
        if self.surface_mm is not None and good_frame.motion is not None:
            good_frame = replace(good_frame, motion=replace(good_frame.motion, surface_mm=self.surface_mm.copy()))
        return self.spoil.get(frame.index, lambda same: same)(good_frame)

    @property
    def learner(self) -> "RecordingPipeline":
        return self

    @property
    def status(self) -> LearningStatus:
        return LearningStatus(
            model=self.model,
            model_shortcoming=self.model_shortcoming,
            model_generation=self.model_generation,
            is_model_waiting=self.is_model_waiting,
            has_reference=self.has_reference,
            reference_number=self.zero_number,
            reference_proposals=self.proposals,
            reference_distance=self.distance if self.has_reference else None,
            is_position_required=self.is_position_required,
            position_check=self.position_check if self.has_reference else None,
        )

    def learned_ranges(self, choices: Iterable[SignalChoice]) -> Ranges:
        return {choice: self.ranges[choice] for choice in choices if choice in self.ranges}

    def learned_levels(self, choices: Iterable[SignalChoice]) -> LearnedLevels:
        ranges = {
            choice: self.ranges.get(choice, next(iter(self.ranges.values()))) for choice in choices if self.ranges
        }
        return {choice: np.linspace(one.low, one.high, 60) for choice, one in ranges.items()}

    def correct_baseline(self, choice: SignalChoice, by: float) -> None:
        self.calls.append(f"correct {choice.label} {by:g}")

    def reference_distance(self, _moment: ReferenceMoment) -> ReferenceDistance | None:
        return self.distance_of_next

    def set_reference(self, moment: ReferenceMoment = ReferenceMoment.NOW, *, most_mm: float | None = None) -> None:
        self.moments.append(moment)
        self.most_mm.append(most_mm)
        self._change("set_reference")
        self.zero_number += 1

    def retrain(self, *, keeps_reference: bool = True) -> None:
        self.calls.append("retrain" if keeps_reference else "retrain without zero")

    def keep_model(self, *, is_kept: bool) -> None:
        self.was_kept.append(is_kept)

    def apply_model(self) -> None:
        self.is_model_waiting = False
        self._change("apply")

    def learn(self) -> None:
        self.after_decision()

    def camera_returned(self) -> None:
        self.has_reference = False
        self._change("camera_returned")

    def camera_warmed(self) -> None:
        self.has_reference = False
        self._change("camera_warmed")

    def take_notices(self) -> list[LearningEvent]:
        taken, self.notices = self.notices, []
        return taken

    def activate(self, model: MotionModel) -> None:
        self.model = model
        self._change("activate")

    def _change(self, name: str) -> None:
        self.calls.append(name)
        if self.trouble is not None:
            raise self.trouble
        self.model_generation += 1


class SteppedWatchdog(Watchdog):
    """A watchdog without its thread: the test calls check()."""

    @property
    def is_watching(self) -> bool:
        return True

    def start(self) -> None:
        """No thread: a manual clock and a real thread would race."""


class WatchedBeamLine(SimulatedBeamLine):
    """The simulated line, with a note of every permit, and a place to interfere before one."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self.permits: list[Lease] = []
        self.before_permit: Callable[[Lease], None] = lambda _lease: None

    def permit(self, lease: Lease) -> None:
        self.before_permit(lease)
        super().permit(lease)
        self.permits.append(lease)


def driver_of(beam: SimulatedBeamLine, clock: Clock) -> BeamDriver:
    """Return a driver of this line by itself."""
    watchdog = SteppedWatchdog(beam=beam, clock=clock, deadline_ns=int(LIMITS.watchdog_ms * MS))
    return BeamDriver(line=LineOrders(beam, clock=clock, watchdog=watchdog), clock=clock, limits=LIMITS)


class Bench:
    """A loop with everything around it, run to the end of a script."""

    def __init__(
        self,
        script: Sequence[Step],
        *,
        limits: GateLimits = LIMITS,
        beam: Callable[[Clock], SimulatedBeamLine] = WatchedBeamLine,
        is_written: bool = True,
        fraction_arming: FractionArming | None = None,
        **capacities: int,
    ) -> None:
        self.clock = ManualClock(START_NS)
        self.beam = beam(self.clock)
        self.source = ScriptedSource(self.clock, script)
        self.source.beam = self.beam
        self.pipeline = RecordingPipeline(self.clock)
        self.watchdog = SteppedWatchdog(beam=self.beam, clock=self.clock, deadline_ns=int(limits.watchdog_ms * MS))
        self.loop = EngineLoop(
            source=self.source,
            measurer=self.pipeline,
            learner=self.pipeline,
            beam=self.beam,
            limits=limits,
            clock=self.clock,
            watchdog=self.watchdog,
            fraction_arming=fraction_arming,
            **capacities,
        )
        self.answers: list[Future[None]] = []
        self._records: list[FrameRecord] = []
        self._transitions: list[GateTransition] = []
        if is_written and not capacities:
            self.source.on_read = self._write

    def _write(self) -> None:
        """Take what the loop has for the disk, as the service's writer does."""
        self._records += drained(self.loop.samples)
        self._transitions += drained(self.loop.transitions)

    def ask(self, command: Command) -> Callable[[], None]:
        """An act for `after`: submit the command, keep the answer."""
        return lambda: self.answers.append(self.loop.submit(command))

    def run(self) -> "Bench":
        self.loop.start()
        assert self.loop.join(timeout_s=120.0), "the loop did not end"
        return self

    def records(self) -> list[FrameRecord]:
        self._write()
        taken, self._records = self._records, []
        return taken

    def transitions(self) -> list[GateTransition]:
        self._write()
        taken, self._transitions = self._transitions, []
        return taken

    def path(self) -> list[str]:
        """States and reasons the gate went through, in short."""
        return [f"{change.to_state}:{change.reason or ''}" for change in self.transitions()]

    def hold_reason_of_the_line(self) -> HoldReason | None:
        """Why the line last went off."""
        return self.beam.edges[-1].reason


def drained(filled: "queue.Queue[T]") -> list[T]:
    """Everything in a queue."""
    taken: list[T] = []
    while not filled.empty():
        taken.append(filled.get_nowait())
    return taken
