"""The engine thread: reads a frame, measures it, decides, drives the beam line, and only then publishes.

It alone owns the source, the measurer, the gate and the line. Other threads submit commands
(:meth:`EngineLoop.submit`), read the bounded output queues, and read the newest :class:`EngineStatus`. Every way out of
it holds the beam before anything else.
"""

import contextlib
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

from engine.beam.beam_on import BeamOnState
from engine.beam.line import BeamLine
from engine.capture.source import DepthSource
from engine.control.arming import Arming
from engine.control.beam_driver import LineOrders
from engine.control.gate_controller import GateController
from engine.control.journal.journal import Journal
from engine.control.output_queues import OutputQueues
from engine.control.outputs import FrameRecord, GateTransition, LoopStatus
from engine.control.records import DecisionRecords, EngineStatus, LiveViews, no_camera_view, no_signal
from engine.control.session import EngineSession
from engine.control.session_state import Learner, Measurer, SessionLimits
from engine.control.turn_inputs import Command, CommandQueue, TurnReader
from engine.control.watchdog import Watchdog
from engine.core.clock import Clock
from engine.core.errors import (
    BeamLineError,
    RecordingError,
    SourceEndedError,
    SourceLostError,
)
from engine.core.fraction_arming import FractionArming
from engine.core.frames import RgbdFrame
from engine.core.gate_state import HoldReason
from engine.core.input_tap import NO_TAP, InputKind, InputTap, TappedClock
from engine.core.learning_status import LearningEvent
from engine.core.position_check import CameraView
from engine.core.replacing import replace
from engine.core.sentences import say
from engine.gating.gate import Ending, Gate, Interruption
from engine.gating.interlocks import OperatorPresence
from engine.gating.limits import GateLimits, ns_from_ms
from engine.gating.supervision.supervisor import FrameSupervisor


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
    fraction_arming
        What earlier sessions of the fraction were armed with; None where it was not armed.

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
        fraction_arming: FractionArming | None = None,
    ) -> None:
        self._source, self._learner, self._beam = source, learner, beam
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
        self._arming = Arming(learner, self._limits, fraction_arming)
        self._views = LiveViews(
            limits=self._limits,
            outputs=self._outputs,
            watchdog=self._watchdog,
            beam_on=beam_on,
            arming=self._arming,
            supervisor=self._supervisor,
            camera_view=camera_view,
        )
        records = DecisionRecords(
            clock=self._clock, limits=self._limits, outputs=self._outputs, views=self._views, tap=tap
        )
        self._controller = GateController(
            reader=self._reader,
            line=self._line,
            clock=self._clock,
            limits=self._limits,
            records=records,
            watchdog=self._watchdog,
        )
        self._session = EngineSession(
            reader=self._reader,
            measurer=measurer,
            learner=learner,
            line=self._line,
            controller=self._controller,
            supervisor=self._supervisor,
            presence=self._presence,
            limits=self._limits,
            arming=self._arming,
            outputs=self._outputs,
            publish=self._publish,
            hold=beam.hold,
        )
        self.on_turn: Callable[[], None] = _do_nothing
        beam.on_trouble = self.report_fault  # a line with its own thread detects faults between two frames
        self._published = EngineStatus()
        self._opened_ns = 0
        self._thread = threading.Thread(target=self._work, name="tidegate-engine", daemon=True)

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
            self._commands.close(say("the engine hangs; the beam is held"))
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
            event=Interruption(reason=HoldReason.ENGINE_FAILED, detail=say("the engine thread was ended")),
            error=say("the engine thread was ended"),
        )
        try:
            self._tap.begin()
            self._open()
            while not (turn := self._reader.turn()).is_stop_requested:
                self._session.run(turn.commands, self._opened_ns)
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
        self._supervisor.begin(description.cold_share)
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
            self._commands.close(say("the session is over"))
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
            predicted_duty_percent=self._arming.forecast.percent,
            learned_ranges=self._arming.forecast.ranges,
            arming_state=self._arming.state,
            is_reason_needed=self._arming.is_reason_needed,
            countersignature=self._arming.signed,
            fraction_arming=self._arming.budget.arming,
        )


def _do_nothing() -> None:
    """Do nothing after a turn: the default of ``on_turn``."""


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
