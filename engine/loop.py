"""The engine thread: reads, measures, decides, tells the beam line, and only then anybody else.

It alone owns the source, the pipeline, the gate and the line. Others reach it through :meth:`EngineLoop.submit` and see
what leaves through two bounded queues and one newest view. Every way out of it holds the beam before anything else.
"""

import contextlib
import queue
import threading
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TYPE_CHECKING

from engine.beam.line import BeamLine
from engine.beam.witnessed import WitnessedLine
from engine.capture.source import DepthSource, SourceDescription
from engine.clock import NS_PER_MS, NS_PER_S, Clock
from engine.commands import Command
from engine.errors import (
    BeamLineError,
    FrameTimeoutError,
    RecordingError,
    SourceAwayError,
    SourceEndedError,
    SourceLostError,
    TidegateError,
)
from engine.frame_pipeline import FramePipeline
from engine.frame_watch import FrameWatch
from engine.frames import Measurement, RgbdFrame
from engine.keeper import Cause, GateKeeper
from engine.limits import GateLimits, ns_from_ms
from engine.live import FrameRecord, GateTransition, LiveView, LoopStatus
from engine.mailbox import URGENT, Letter, Mailbox
from engine.notices import LearningNotice
from engine.orders import Orders
from engine.outbox import Outbox
from engine.permits import HoldReason
from engine.stages.gate import Ending, Gate, GateEvent, Interruption, Silence
from engine.transition_journal import Journal
from engine.watchdog import Watchdog
from engine.witness import NOBODY, Seam, Witness, WitnessedClock

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["EngineLoop", "FramePipeline", "FrameRecord", "GateTransition", "LiveView", "LoopStatus"]

FIRST_FRAME_NS = 10 * NS_PER_S
"""A camera that was opened and shows nothing for so long is lost."""

SHORTEST_READ_NS = NS_PER_MS


@dataclass(frozen=True, slots=True, kw_only=True)
class _WayOut:
    """How an engine's life ends, and what the gate is told of it."""

    status: LoopStatus
    event: Ending | Interruption
    error: str | None = None


class EngineLoop:
    """One session's engine, for one life: start, stop, never again.

    Parameters
    ----------
    sample_capacity, transition_capacity, command_capacity
        Bounds of the queues; 900 samples are half a minute.
    watchdog
        One of the caller's, on the same line; by default the loop makes its own.
    journal
        Where transitions are kept that a kill must not lose; by default nowhere.
    witness
        Hears what the engine's thread hears, and what came of it: a tape, or a replay of one.

    Attributes
    ----------
    on_turn
        Called in the engine's thread after each turn, and at the end: there is news. Must not wait, nor raise.
    """

    def __init__(
        self,
        *,
        source: DepthSource,
        pipeline: FramePipeline,
        beam: BeamLine,
        limits: GateLimits,
        clock: Clock,
        sample_capacity: int = 900,
        transition_capacity: int = 256,
        command_capacity: int = 16,
        watchdog: Watchdog | None = None,
        journal: Journal | None = None,
        witness: Witness = NOBODY,
    ) -> None:
        self._source, self._pipeline, self._beam = source, pipeline, beam
        self._witness, self._line = witness, WitnessedLine(beam, witness)
        self._limits, self._clock = limits, WitnessedClock(clock, witness)
        self._mailbox = Mailbox(
            clock=clock, capacity=command_capacity, longest_silence_ns=ns_from_ms(limits.max_service_silence_ms)
        )
        self._outbox = Outbox(sample_capacity=sample_capacity, transition_capacity=transition_capacity, journal=journal)
        deadline_ns = ns_from_ms(limits.watchdog_ms)
        self._watchdog = watchdog or Watchdog(beam=beam, clock=clock, deadline_ns=deadline_ns)
        self._keeper = GateKeeper(
            beam=self._line,
            clock=clock,
            limits=limits,
            outbox=self._outbox,
            mailbox=self._mailbox,
            watchdog=self._watchdog,
            witness=witness,
        )
        self.on_turn: Callable[[], None] = _tell_nobody
        beam.on_trouble = self.report_fault  # a line with a thread of its own finds trouble between two frames
        self._watch = FrameWatch(limits)
        self._orders = Orders(
            pipeline=pipeline,
            beam=self._line,
            limits=limits,
            keeper=self._keeper,
            watch=self._watch,
            watchdog=self._watchdog,
            outbox=self._outbox,
            witness=witness,
        )
        self._listening_since_ns = 0
        self._is_camera_away = False
        self._stop_requested = threading.Event()
        self._thread = threading.Thread(target=self._work, name="tidegate-engine", daemon=True)

    def start(self) -> None:
        """Start the engine and its watchdog; a failure to open shows in :attr:`status` and :attr:`error`."""
        self._watchdog.start()
        self._thread.start()

    def run_here(self) -> None:
        """Live this life in the calling thread, with nobody who watches: for replays, which drive no line."""
        self._work()

    def stop(self, timeout_s: float) -> bool:
        """Hold the beam and end; return whether the engine thread is gone. A hung one leaves the line latched off."""
        self._stop_requested.set()
        if self._thread.ident is None:
            self._mailbox.close("the engine was never started")
            return True
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            self._beam.hold(HoldReason.ENGINE_STOPPED)
            self._mailbox.close("the engine hangs; the beam is held")
            with contextlib.suppress(Exception):
                self._beam.close()  # a line of its own threads would go on beside the next session's
        return not self._thread.is_alive()

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait for the end without asking for it; return whether it has come."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def submit(
        self, command: Command, *, answer: Future[None] | None = None, submitted_ns: int | None = None
    ) -> Future[None]:
        """Ask for something, from any thread; answered between two frames.

        ``answer`` and ``submitted_ns`` are those of a command that another process has asked for.

        Raises
        ------
        CommandRefusedError
            Too many commands wait already, or the session is over. What the engine itself refuses comes through the
            future. A :class:`Disarm` or :class:`HoldBeam` is never refused while the engine runs.
        """
        return self._mailbox.submit(command, answer=answer, submitted_ns=submitted_ns)

    def report_fault(self, reason: HoldReason, detail: str) -> None:
        """Let somebody outside (a recorder, a disk) fault the gate at its next decision; ``reason`` must latch.

        Report it again for as long as it lasts: one that comes while another fault is latched goes with its
        acknowledgement.
        """
        self._mailbox.report(Interruption(reason=reason, detail=detail))

    def hold_line(self, reason: HoldReason) -> None:
        """Hold the line now, from any thread, as the watchdog does; a ``reason`` that is a fault latches it."""
        self._beam.hold(reason)

    def note_service(self, alive_ns: int) -> None:
        """Hear that the process which asks was alive then; from the first time on its silence is a fault."""
        self._mailbox.note_service(alive_ns)

    def note_presence(self, operator: str) -> None:
        """Hear that a person's page is still looked at, from any thread; never waits."""
        self._keeper.note_presence(operator)

    @property
    def samples(self) -> queue.Queue[FrameRecord]:
        """One record a frame; drain it, or the gate faults."""
        return self._outbox.samples

    @property
    def transitions(self) -> queue.Queue[GateTransition]:
        """Every change of the gate; drain it, or the gate faults.

        What found it full is offered again here, so that a reader gets the last ones after the engine has ended too.
        """
        self._outbox.flush()
        return self._outbox.transitions

    @property
    def notices(self) -> queue.Queue[LearningNotice]:
        """What the learning has to tell; drain it, or the gate faults."""
        self._outbox.flush()
        return self._outbox.notices

    @property
    def latest(self) -> LiveView | None:
        """The newest view; None before the first frame."""
        return self._keeper.latest

    @property
    def status(self) -> LoopStatus:
        """Where this engine's life stands."""
        return self._keeper.status

    @property
    def error(self) -> str | None:
        """What it failed of."""
        return self._keeper.error

    @property
    def gate(self) -> Gate:
        """The gate as last decided."""
        return self._keeper.gate

    @property
    def description(self) -> SourceDescription | None:
        """What the source said it is; None until it was opened."""
        return self._keeper.description

    # The engine thread, from here on.

    def _work(self) -> None:
        way_out = _WayOut(
            status=LoopStatus.FAILED,
            event=Interruption(reason=HoldReason.ENGINE_FAILED, detail="the engine thread was ended"),
            error="the engine thread was ended",
        )
        try:
            self._witness.begin()
            self._open()
            while not self._is_stop_requested():
                self._run_once()
                self._witness.turn()
                self.on_turn()
            way_out = _WayOut(status=LoopStatus.ENDED, event=Ending(reason=HoldReason.ENGINE_STOPPED))
        except Exception as error:  # noqa: BLE001 - whatever it was: the beam is held, and the session has failed
            way_out = _way_out_of(error)
        finally:
            self._leave(way_out)

    def _open(self) -> None:
        self._line.open()
        self._line.hold(HoldReason.DISARMED)
        description = self._witness.heard(Seam.SOURCE_OPENED, self._source.open)
        self._listening_since_ns = self._clock.now_ns()
        self._keeper.begin(description)

    def _leave(self, way_out: _WayOut) -> None:
        """Hold, then tell, then close: closing a camera may hang, and nobody would hear of the end."""
        with contextlib.suppress(Exception):
            self._beam.hold(way_out.event.reason)
        try:
            self._keeper.finish(way_out.event, way_out.status, way_out.error)
        finally:
            self._witness.end()
            self._mailbox.close("the session is over")
            self.on_turn()
            for close in (self._beam.close, self._source.close, self._watchdog.stop):
                with contextlib.suppress(Exception):
                    close()

    def _run_once(self) -> None:
        for letter in self._witness.heard(Seam.LETTERS, self._mailbox.take):
            self._answer(letter)
        try:
            frame = self._read()
        except SourceAwayError as error:
            self._stay_without_camera(str(error))
            return
        except FrameTimeoutError:
            self._stay_silent()
            return
        if self._is_camera_away:
            self._is_camera_away = False
            self._pipeline.camera_returned()
        self._pipeline.keep_model(is_kept=self._keeper.gate.is_armed)
        measurement = self._pipeline.measure(frame)
        notices = self._pipeline.take_notices()
        self._outbox.put_notices(notices)
        self._keeper.standing = self._watch.look(
            frame,
            measurement,
            model=self._pipeline.model,
            has_zero=self._pipeline.has_reference,
            notices=notices,
        )
        self._decide_on(frame, measurement)

    def _read(self) -> RgbdFrame:
        timeout_s = self._read_timeout_ns() / NS_PER_S
        return self._witness.heard(Seam.FRAME, lambda: self._source.read(timeout_s))

    def _is_stop_requested(self) -> bool:
        return self._witness.heard(Seam.STOP_ASKED, self._stop_requested.is_set)

    def _read_timeout_ns(self) -> int:
        """Until the next frame is missing: counted from when the last one came, not from now."""
        longest_ns = ns_from_ms(self._limits.max_gap_ms)
        last = self._keeper.gate.last
        left_ns = longest_ns if last is None else last.received_ns + longest_ns - self._clock.now_ns()
        return left_ns if SHORTEST_READ_NS <= left_ns <= longest_ns else longest_ns

    def _stay_without_camera(self, detail: str) -> None:
        """Fault for as long as the camera is away, whoever acknowledges meanwhile."""
        self._is_camera_away = True
        self._keeper.standing = (Interruption(reason=HoldReason.SOURCE_LOST, detail=detail),)
        self._keeper.decide()

    def _stay_silent(self) -> None:
        self._keeper.decide(Silence(since_ns=self._listening_since_ns))
        waited_ns = self._clock.now_ns() - self._listening_since_ns
        if self._keeper.gate.last is None and waited_ns > FIRST_FRAME_NS:
            msg = f"the source was opened, and showed nothing for {FIRST_FRAME_NS // NS_PER_S} s"
            raise SourceLostError(msg)

    def _decide_on(self, frame: RgbdFrame, measurement: Measurement) -> None:
        events: list[GateEvent] = []
        if self._orders.has_model_changed():
            events.append(Ending(reason=HoldReason.DISARMED))
        self._orders.settle_window()
        if not _is_of(measurement, frame):
            events.append(Interruption(reason=HoldReason.VALUE_INVALID, detail="a measurement of another frame"))
        events.append(measurement)
        if self._pipeline.model is None:
            events.append(Interruption(reason=HoldReason.MODEL_MISSING))
        elif not self._pipeline.has_reference:
            events.append(Interruption(reason=HoldReason.REFERENCE_MISSING))
        if self._is_stop_requested():  # while this frame was measured: it must not turn anything on any more
            events.append(Ending(reason=HoldReason.ENGINE_STOPPED))
        self._keeper.decide(*events, cause=Cause(frame=frame, measurement=measurement))

    # Commands.

    def _answer(self, letter: Letter) -> None:
        """Obey, and answer only when the line has been told."""
        is_wanted = self._witness.heard(Seam.IS_WANTED, letter.answer.set_running_or_notify_cancel)
        if not is_wanted and not isinstance(letter.command, URGENT):
            return
        try:
            self._orders.obey(letter.command)
        except TidegateError as error:
            letter.answer.set_exception(error)
        except BaseException as error:
            self._beam.hold(HoldReason.ENGINE_FAILED)
            letter.answer.set_exception(error)
            raise
        else:
            if is_wanted:
                letter.answer.set_result(None)


def _tell_nobody() -> None:
    """Tell of no turn: what an engine has whose news nobody waits for."""


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
