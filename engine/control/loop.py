"""The engine thread: reads a frame, measures it, decides, drives the beam line, and only then publishes.

It alone owns the source, the measurer, the gate and the line. Other threads submit commands
(:meth:`EngineLoop.submit`), read the bounded output queues, and read the newest :class:`EngineStatus`. Every way out of
it holds the beam before anything else.
"""

import contextlib
import queue
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from dataclasses import dataclass

from engine.beam.beam_on import BeamOnState
from engine.beam.line import BeamLine
from engine.capture.source import DepthSource
from engine.control.arming_outlook import ArmingOutlook
from engine.control.command_handler import CommandHandler
from engine.control.command_queue import URGENT, CommandQueue, QueuedCommand
from engine.control.commands import Command
from engine.control.decision_records import DecisionRecords
from engine.control.decisions import Cause
from engine.control.engine_status import EngineStatus
from engine.control.gate_controller import GateController
from engine.control.journal.journal import Journal
from engine.control.line_orders import LineOrders
from engine.control.live_views import LiveViews, no_camera_view, no_signal
from engine.control.model_follower import ModelFollower
from engine.control.output_queues import OutputQueues
from engine.control.outputs import FrameRecord, GateTransition, LoopStatus
from engine.control.position_sign_off import PositionSignOff
from engine.control.reference_budget import ReferenceBudget
from engine.control.roles import Learner, Measurer
from engine.control.session_limits import SessionLimits
from engine.control.turn_inputs import CommandInputs
from engine.control.turn_reader import TurnReader
from engine.control.watchdog import Watchdog
from engine.core.camera_view import CameraView
from engine.core.clock import NS_PER_S, Clock
from engine.core.errors import (
    BeamLineError,
    RecordingError,
    SourceEndedError,
    SourceLostError,
    TidegateError,
)
from engine.core.frames import Measurement, RgbdFrame
from engine.core.gate_state import HoldReason
from engine.core.input_tap import NO_TAP, InputKind, InputTap, TappedClock
from engine.core.learning_events import LearningEvent
from engine.core.replacing import replace
from engine.gating.gate import Ending, Gate, GateEvent, Interruption, Silence
from engine.gating.limits import GateLimits, ns_from_ms
from engine.gating.supervision.operator_presence import OperatorPresence
from engine.gating.supervision.supervisor import FrameSupervisor

FIRST_FRAME_NS = 10 * NS_PER_S
"""Longest time from the opening of a camera to its first frame; then it is lost."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _WayOut:
    """How the engine ends: its final status, and the gate's last event."""

    status: LoopStatus
    event: Ending | Interruption
    error: str | None = None


class EngineLoop:
    """The engine of one session: started once, stopped once.

    Parameters
    ----------
    sample_capacity, transition_capacity, command_capacity
        Bounds of the queues; 900 samples are half a minute.
    watchdog
        A watchdog on the same line; by default the loop makes its own.
    journal
        Keeps transitions when the process is killed; by default none.
    tap
        Observes what the engine thread reads and what it outputs: records a tape, or replays one.
    beam_on
        The accelerator's signal compared with the permit, for the view alone; by default there is none.
    camera_view
        Describes how the camera looks, for the view alone, while the gate is disarmed; by default nothing does.

    Attributes
    ----------
    on_turn
        Called in the engine thread after each turn and at the end, when there is a new status. Must not wait or raise.
    """

    def __init__(
        self,
        *,
        source: DepthSource,
        measurer: Measurer,
        learner: Learner,
        beam: BeamLine,
        limits: GateLimits,
        clock: Clock,
        sample_capacity: int = 900,
        transition_capacity: int = 256,
        command_capacity: int = 16,
        watchdog: Watchdog | None = None,
        journal: Journal | None = None,
        tap: InputTap = NO_TAP,
        beam_on: Callable[[], BeamOnState | None] = no_signal,
        camera_view: Callable[[RgbdFrame], CameraView | None] = no_camera_view,
    ) -> None:
        self._source, self._measurer, self._learner, self._beam = source, measurer, learner, beam
        self._tap, self._clock = tap, TappedClock(clock, tap)
        self._commands = CommandQueue(
            clock=clock, capacity=command_capacity, longest_silence_ns=ns_from_ms(limits.max_service_silence_ms)
        )
        self._outputs = OutputQueues(
            sample_capacity=sample_capacity, transition_capacity=transition_capacity, journal=journal
        )
        deadline_ns = ns_from_ms(limits.watchdog_ms)
        self._watchdog = watchdog or Watchdog(beam=beam, clock=clock, deadline_ns=deadline_ns)
        self._limits = SessionLimits(limits)
        self._presence = OperatorPresence(clock=clock, timeout_s=limits.operator_timeout_s)
        self._stop_requested = threading.Event()
        self._reader = TurnReader(
            source=source,
            clock=clock,
            limits=self._limits,
            commands=self._commands,
            outputs=self._outputs,
            watchdog=self._watchdog,
            presence=self._presence,
            stop_requested=self._stop_requested,
            tap=tap,
        )
        self._line = LineOrders(beam, clock=clock, watchdog=self._watchdog, tap=tap)
        self._supervisor = FrameSupervisor(limits)
        budget = ReferenceBudget(learner, self._limits)
        self._sign_off = PositionSignOff(learner, self._limits)
        self._follower = ModelFollower(learner, self._limits)
        self._outlook = ArmingOutlook(learner, self._limits, budget)
        self._views = LiveViews(
            limits=self._limits,
            outputs=self._outputs,
            watchdog=self._watchdog,
            beam_on=beam_on,
            reference_distance=budget.present,
            movement=lambda: self._supervisor.movement,
            checks=lambda: self._supervisor.checks,
            marker_travel_mm=lambda: self._supervisor.marker_travel_mm,
            position=self._sign_off.present,
            camera_view=camera_view,
        )
        self._controller = self._make_controller()
        self._handler = CommandHandler(
            measurer=measurer,
            learner=learner,
            line=self._line,
            limits=self._limits,
            controller=self._controller,
            follower=self._follower,
            presence=self._presence,
            supervisor=self._supervisor,
            budget=budget,
            outlook=self._outlook,
            sign_off=self._sign_off,
        )
        self.on_turn: Callable[[], None] = _do_nothing
        beam.on_trouble = self.report_fault  # a line with its own thread detects faults between two frames
        self._published = EngineStatus()
        self._opened_ns = 0
        self._is_camera_away = False
        self._thread = threading.Thread(target=self._work, name="tidegate-engine", daemon=True)

    def _make_controller(self) -> GateController:
        records = DecisionRecords(
            clock=self._clock, limits=self._limits, outputs=self._outputs, views=self._views, tap=self._tap
        )
        return GateController(
            reader=self._reader,
            line=self._line,
            clock=self._clock,
            limits=self._limits,
            records=records,
            watchdog=self._watchdog,
        )

    def start(self) -> None:
        """Start the engine and its watchdog; a failure to open shows in :attr:`status`."""
        self._watchdog.start()
        self._thread.start()

    def run_here(self) -> None:
        """Run in the calling thread, without the watchdog: for replays, which drive no line."""
        self._work()

    def stop(self, timeout_s: float) -> bool:
        """Hold the beam and end; return whether the engine thread is gone. A hung one leaves the line latched off."""
        self._stop_requested.set()
        if self._thread.ident is None:
            self._commands.close("the engine was never started")
            return True
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            self._beam.hold(HoldReason.ENGINE_STOPPED)
            self._commands.close("the engine hangs; the beam is held")
            with contextlib.suppress(Exception):
                self._beam.close()  # a line with its own threads would run on beside the next session's
        return not self._thread.is_alive()

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait for the engine to end by itself; return whether it has."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def submit(
        self, command: Command, *, answer: Future[None] | None = None, submitted_ns: int | None = None
    ) -> Future[None]:
        """Submit a command from any thread; it is answered between two frames.

        ``answer`` and ``submitted_ns`` are those of a command that was submitted in another process.

        Raises
        ------
        CommandRefusedError
            Too many commands wait already, or the session is over. A refusal by the engine itself is set on the future.
            A :class:`Disarm` or :class:`HoldBeam` is never refused while the engine runs.
        """
        return self._commands.submit(command, answer=answer, submitted_ns=submitted_ns)

    def report_fault(self, reason: HoldReason, detail: str) -> None:
        """Fault the gate at its next decision, because a recorder or a disk failed; ``reason`` must latch.

        Report it again for as long as it lasts: a fault that is reported while another one is latched is cleared with
        it.
        """
        self._commands.report(Interruption(reason=reason, detail=detail))

    def hold_line(self, reason: HoldReason) -> None:
        """Hold the line now, from any thread, as the watchdog does; a ``reason`` that is a fault latches the line."""
        self._beam.hold(reason)

    def note_service(self, alive_ns: int) -> None:
        """Note that the service served at ``alive_ns``; from the first time on its silence is a fault."""
        self._commands.note_service(alive_ns)

    def note_presence(self, operator: str) -> None:
        """Note that the page of a person who may arm is open, from any thread; never waits."""
        self._presence.note(operator)

    @property
    def samples(self) -> queue.Queue[FrameRecord]:
        """One record per frame; a full queue faults the gate."""
        return self._outputs.samples

    @property
    def transitions(self) -> queue.Queue[GateTransition]:
        """Every transition of the gate; a full queue faults the gate.

        Transitions that did not fit are offered again here, so that a reader gets the last ones after the end too.
        """
        self._outputs.flush()
        return self._outputs.transitions

    @property
    def notices(self) -> queue.Queue[LearningEvent]:
        """Learning events; a full queue faults the gate."""
        self._outputs.flush()
        return self._outputs.notices

    @property
    def status(self) -> EngineStatus:
        """The newest status; where the engine hangs, its view is shown as the watchdog's fault."""
        published = self._published
        view = self._views.shown(published.view)
        return published if view is published.view else replace(published, view=view)

    @property
    def gate(self) -> Gate:
        """The gate as of the last decision."""
        return self._controller.gate

    # Everything below runs in the engine thread.

    def _work(self) -> None:
        way_out = _WayOut(
            status=LoopStatus.FAILED,
            event=Interruption(reason=HoldReason.ENGINE_FAILED, detail="the engine thread was ended"),
            error="the engine thread was ended",
        )
        try:
            self._tap.begin()
            self._open()
            while not (turn := self._reader.turn()).is_stop_requested:
                self._run_once(turn.commands)
                self._publish()
                self._tap.turn()
                self.on_turn()
            way_out = _WayOut(status=LoopStatus.ENDED, event=Ending(reason=HoldReason.ENGINE_STOPPED))
        except Exception as error:  # noqa: BLE001 - any error: the beam is held, and the session has failed
            way_out = _way_out_of(error)
        finally:
            self._leave(way_out)

    def _open(self) -> None:
        self._line.connect()
        description = self._tap.observe(InputKind.SOURCE_OPENED, self._source.open)
        self._opened_ns = self._clock.now_ns()
        self._limits.set_played(is_played=not description.is_live)
        self._views.begin(description)
        self._publish()

    def _leave(self, way_out: _WayOut) -> None:
        """Hold, then record and publish, then close: closing a camera may hang."""
        with contextlib.suppress(Exception):
            self._beam.hold(way_out.event.reason)
        try:
            self._decide_last(way_out)
        finally:
            self._tap.end()
            self._commands.close("the session is over")
            self.on_turn()
            for close in (self._beam.close, self._source.close, self._watchdog.stop):
                with contextlib.suppress(Exception):
                    close()

    def _decide_last(self, way_out: _WayOut) -> None:
        try:
            self._controller.decide(way_out.event)
        finally:
            self._views.end(way_out.status, way_out.error)
            self._publish()

    def _publish(self) -> None:
        """Replace the published status; done before a command is answered, and before ``on_turn``."""
        self._published = EngineStatus(
            run_state=self._views.run_state,
            error=self._views.error,
            source=self._views.description,
            view=self._views.newest,
            learning=self._learner.status,
            predicted_duty_percent=self._outlook.forecast.percent,
            learned_ranges=self._outlook.forecast.ranges,
            arming_state=self._outlook.state,
            is_reason_needed=self._outlook.is_reason_needed,
            countersignature=self._outlook.signed,
        )

    def _run_once(self, commands: Iterable[QueuedCommand]) -> None:
        for queued in commands:
            self._answer(queued)
        last = self._controller.gate.last
        read = self._reader.frame(last_received_ns=None if last is None else last.received_ns)
        if read.frame is not None:
            self._measure(read.frame)
        elif read.away is not None:
            self._decide_without_camera(read.away)
        else:
            self._decide_without_frame(read.at_ns)

    def _measure(self, frame: RgbdFrame) -> None:
        """Measure a frame, and decide on it."""
        if self._is_camera_away:
            self._is_camera_away = False
            self._measurer.camera_returned()
        self._learner.keep_model(is_kept=self._controller.gate.is_armed)
        measurement = self._measurer.measure(frame)
        notices = self._learner.take_notices()
        self._outputs.put_notices(notices)
        supervision = self._supervisor.check(
            frame,
            measurement,
            window=self._limits.current.window,
            model=self._learner.status.model,
            has_reference=self._learner.status.has_reference,
            notices=notices,
        )
        self._sign_off.follow(measurement, supervision)
        unsigned = self._sign_off.interruption()
        self._decide_on(frame, measurement, supervision if unsigned is None else (unsigned, *supervision))

    def _decide_without_camera(self, detail: str) -> None:
        """Fault for as long as the camera is away; an acknowledgement meanwhile does not clear it."""
        self._is_camera_away = True
        self._controller.decide(supervision=(Interruption(reason=HoldReason.SOURCE_LOST, detail=detail),))

    def _decide_without_frame(self, timed_out_ns: int) -> None:
        self._controller.decide(Silence(since_ns=self._opened_ns))
        if self._controller.gate.last is None and timed_out_ns - self._opened_ns > FIRST_FRAME_NS:
            msg = f"the source was opened, and showed nothing for {FIRST_FRAME_NS // NS_PER_S} s"
            raise SourceLostError(msg)

    def _decide_on(self, frame: RgbdFrame, measurement: Measurement, supervision: tuple[Interruption, ...]) -> None:
        events: list[GateEvent] = []
        if self._follower.has_changed():
            events.append(Ending(reason=HoldReason.DISARMED))
        self._follower.resolve_window()
        if not _is_of(measurement, frame):
            events.append(Interruption(reason=HoldReason.VALUE_INVALID, detail="a measurement of another frame"))
        events.append(measurement)
        if self._learner.status.model is None:
            events.append(Interruption(reason=HoldReason.MODEL_MISSING))
        elif not self._learner.status.has_reference:
            events.append(Interruption(reason=HoldReason.REFERENCE_MISSING))
        self._controller.decide(*events, cause=Cause(frame=frame, measurement=measurement), supervision=supervision)

    # Commands.

    def _answer(self, queued: QueuedCommand) -> None:
        """Carry a command out; answer it once the line has been driven."""
        inputs = self._reader.command(queued)
        if not inputs.is_wanted and not isinstance(queued.command, URGENT):
            return
        try:
            self._handle(queued.command, inputs)
        except TidegateError as error:
            queued.answer.set_exception(error)
        except BaseException as error:
            self._beam.hold(HoldReason.ENGINE_FAILED)
            queued.answer.set_exception(error)
            raise
        else:
            if inputs.is_wanted:
                queued.answer.set_result(None)

    def _handle(self, command: Command, inputs: CommandInputs) -> None:
        """Carry a command out, and publish the new status before it is answered."""
        try:
            self._handler.handle(command, inputs)
        finally:
            self._publish()


def _do_nothing() -> None:
    """Do nothing after a turn: the default of ``on_turn``."""


def _is_of(measurement: Measurement, frame: RgbdFrame) -> bool:
    return (measurement.frame_index, measurement.timestamp_us, measurement.received_ns, measurement.missed_frames) == (
        frame.index,
        frame.timestamp_us,
        frame.received_ns,
        frame.missed_frames,
    )


def _way_out_of(error: Exception) -> _WayOut:
    text = str(error) or type(error).__name__
    if isinstance(error, SourceEndedError):
        return _WayOut(status=LoopStatus.ENDED, event=Ending(reason=HoldReason.SOURCE_ENDED, detail=text))
    if isinstance(error, SourceLostError | RecordingError):
        reason = HoldReason.SOURCE_LOST
    elif isinstance(error, BeamLineError):
        reason = HoldReason.BEAM_LINE_FAILED
    else:
        reason, text = HoldReason.ENGINE_FAILED, f"{type(error).__name__}: {text}"
    return _WayOut(status=LoopStatus.FAILED, event=Interruption(reason=reason, detail=text), error=text)
