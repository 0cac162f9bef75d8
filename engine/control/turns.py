"""One turn of the engine: commands first, then a frame, then the decision. Owned by the engine thread."""

from collections.abc import Callable, Iterable

from engine.control.command_handler import CommandHandler, ModelFollower
from engine.control.command_queue import URGENT, QueuedCommand
from engine.control.gate_controller import GateController
from engine.control.output_queues import OutputQueues
from engine.control.outputs import Cause
from engine.control.position_sign_off import PositionSignOff
from engine.control.roles import Learner, Measurer
from engine.control.session_limits import SessionLimits
from engine.control.turn_reader import TurnReader
from engine.core.clock import NS_PER_S
from engine.core.errors import SourceLostError, TidegateError
from engine.core.frames import Measurement, RgbdFrame
from engine.core.gate_state import HoldReason
from engine.core.sentences import say
from engine.gating.gate import Ending, GateEvent, Interruption, Silence
from engine.gating.supervision.supervisor import FrameSupervisor

FIRST_FRAME_NS = 10 * NS_PER_S
"""Longest time from the opening of a camera to its first frame; then it is lost."""


class TurnRunner:
    """Runs turns.

    Parameters
    ----------
    publish
        Publishes the engine's status: done before a command is answered.
    hold
        Holds the line at once: done where a command ends the engine.
    """

    def __init__(
        self,
        *,
        reader: TurnReader,
        measurer: Measurer,
        learner: Learner,
        controller: GateController,
        handler: CommandHandler,
        supervisor: FrameSupervisor,
        limits: SessionLimits,
        position: PositionSignOff,
        follower: ModelFollower,
        outputs: OutputQueues,
        publish: Callable[[], None],
        hold: Callable[[HoldReason], None],
    ) -> None:
        self._reader, self._measurer, self._learner = reader, measurer, learner
        self._controller, self._handler, self._supervisor = controller, handler, supervisor
        self._limits, self._position, self._follower, self._outputs = limits, position, follower, outputs
        self._publish, self._hold = publish, hold
        self._is_camera_away = False

    def run(self, commands: Iterable[QueuedCommand], opened_ns: int) -> None:
        """Run a turn; ``opened_ns`` is when the source was opened."""
        for queued in commands:
            self._answer(queued)
        last = self._controller.gate.last
        read = self._reader.frame(last_received_ns=None if last is None else last.received_ns)
        if read.frame is not None:
            self._measure(read.frame)
        elif read.away is not None:
            self._decide_without_camera(read.away)
        else:
            self._decide_without_frame(read.at_ns, opened_ns)

    def _answer(self, queued: QueuedCommand) -> None:
        """Carry a command out; answer it once the line has been driven and the new status is published."""
        inputs = self._reader.command(queued)
        if not inputs.is_wanted and not isinstance(queued.command, URGENT):
            return
        try:
            try:
                self._handler.handle(queued.command, inputs)
            finally:
                self._publish()
        except TidegateError as error:
            queued.answer.set_exception(error)
        except BaseException as error:
            self._hold(HoldReason.ENGINE_FAILED)
            queued.answer.set_exception(error)
            raise
        else:
            if inputs.is_wanted:
                queued.answer.set_result(None)

    def _measure(self, frame: RgbdFrame) -> None:
        """Measure a frame, and decide on it."""
        if self._is_camera_away:
            self._is_camera_away = False
            self._measurer.camera_returned()
        self._learner.keep_model(is_kept=self._controller.gate.is_armed)
        measurement = self._measurer.measure(frame)
        notices = self._learner.take_notices()
        self._outputs.put_notices(notices)
        gated = measurement.as_gated
        supervision = self._supervisor.check(
            frame,
            gated,
            window=self._limits.current.window,
            model=self._learner.status.model,
            has_reference=self._learner.status.has_reference,
            notices=notices,
        )
        self._position.follow(gated, supervision)
        if self._supervisor.take_warmed():
            self._measurer.camera_warmed()
        unsigned = self._position.interruption()
        self._decide_on(frame, measurement, supervision if unsigned is None else (unsigned, *supervision))

    def _decide_on(self, frame: RgbdFrame, measurement: Measurement, supervision: tuple[Interruption, ...]) -> None:
        events: list[GateEvent] = []
        if self._follower.has_changed():
            self._controller.rescale()
            events.append(Ending(reason=HoldReason.DISARMED))
        self._follower.resolve_window()
        if not _is_of(measurement, frame):
            events.append(Interruption(reason=HoldReason.VALUE_INVALID, detail=say("a measurement of another frame")))
        events.append(measurement.as_gated)
        if self._learner.status.model is None:
            events.append(Interruption(reason=HoldReason.MODEL_MISSING))
        elif not self._learner.status.has_reference:
            events.append(Interruption(reason=HoldReason.REFERENCE_MISSING))
        self._controller.decide(*events, cause=Cause(frame=frame, measurement=measurement), supervision=supervision)

    def _decide_without_camera(self, detail: str) -> None:
        """Fault for as long as the camera is away; an acknowledgement meanwhile does not clear it."""
        self._is_camera_away = True
        self._controller.decide(supervision=(Interruption(reason=HoldReason.SOURCE_LOST, detail=detail),))

    def _decide_without_frame(self, timed_out_ns: int, opened_ns: int) -> None:
        self._controller.decide(Silence(since_ns=opened_ns))
        if self._controller.gate.last is None and timed_out_ns - opened_ns > FIRST_FRAME_NS:
            msg = say(
                "the source was opened, and showed nothing for {waited_s} s",
                waited_s=FIRST_FRAME_NS // NS_PER_S,
            )
            raise SourceLostError(msg)


def _is_of(measurement: Measurement, frame: RgbdFrame) -> bool:
    return (measurement.frame_index, measurement.timestamp_us, measurement.received_ns, measurement.missed_frames) == (
        frame.index,
        frame.timestamp_us,
        frame.received_ns,
        frame.missed_frames,
    )
