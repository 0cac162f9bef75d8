"""The session in the engine thread: one turn after another. Commands first, then a frame, then the decision.

A command is carried out between two frames, and refused before anything is changed: first whether it is allowed now,
then the line, then the change itself.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

from engine.control.arming import Arming
from engine.control.beam_driver import LineOrders
from engine.control.gate_controller import GateController
from engine.control.output_queues import OutputQueues
from engine.control.outputs import Cause
from engine.control.session_state import Learner, Measurer, ModelFollower, SessionLimits
from engine.control.turn_inputs import URGENT, Command, CommandInputs, QueuedCommand, TurnReader
from engine.core.breath import SignalChoice
from engine.core.clock import NS_PER_S
from engine.core.commands import (
    Acknowledge,
    ActivateModel,
    ApplyModel,
    Arm,
    CorrectBaseline,
    Countersign,
    Disarm,
    HoldBeam,
    ReleaseBeam,
    Retrain,
    SetReference,
    SignPosition,
)
from engine.core.errors import (
    CommandRefusedError,
    CountersignatureError,
    ReasonMissingError,
    SourceLostError,
    TidegateError,
)
from engine.core.frames import Measurement, RgbdFrame
from engine.core.gate_state import GateState, HoldReason
from engine.core.reference import ReferenceMoment
from engine.core.sentences import say
from engine.gating.active_window import SetWindow
from engine.gating.gate import Ending, GateEvent, Interruption, Silence
from engine.gating.interlocks import OperatorPresence
from engine.gating.supervision.supervisor import FrameSupervisor
from engine.gating.windows import AmplitudeWindow

FIRST_FRAME_NS = 10 * NS_PER_S
"""Longest time from the opening of a camera to its first frame; then it is lost."""
LEVEL_TOLERANCE_MM = MOVE_TOLERANCE_MM = 0.5
"""How far the level of a reference may differ from the one displayed; of the volume a tenth of a litre for each mm."""
NEAR_EXHALE, NEAR_INHALE = 15.0, 85.0
"""Places in the learned breathing range [%] between which the reference of an amplitude window needs a reason."""


class _Level(NamedTuple):
    """A level of the gated signal [mm, l], and its place in the learned breathing range [%]; None where unknown."""

    level: float | None
    percent: float | None


class EngineSession:
    """Runs the turns of a session; owned by the engine thread.

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
        line: LineOrders,
        controller: GateController,
        supervisor: FrameSupervisor,
        presence: OperatorPresence,
        limits: SessionLimits,
        arming: Arming,
        outputs: OutputQueues,
        publish: Callable[[], None],
        hold: Callable[[HoldReason], None],
    ) -> None:
        self._reader, self._measurer, self._learner, self._line = reader, measurer, learner, line
        self._controller, self._supervisor, self._presence = controller, supervisor, presence
        self._limits, self._arming, self._outputs = limits, arming, outputs
        self._publish, self._hold = publish, hold
        self._follower = ModelFollower(learner, limits)
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
                self._carry_out(queued.command, inputs)
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
        self._arming.position.follow(gated, supervision)
        if self._supervisor.take_warmed():
            self._measurer.camera_warmed()
        unsigned = self._arming.position.interruption()
        self._decide_on(frame, measurement, supervision if unsigned is None else (unsigned, *supervision))
        self._measurer.learn()

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

    def _carry_out(self, command: Command, inputs: CommandInputs) -> None:
        """Carry a command out; raise a TidegateError where it is refused."""
        match command:
            case Arm():
                self._arm(command, inputs)
            case Disarm():
                self._controller.disarm(command)
            case HoldBeam():
                self._controller.hold(command)
            case ReleaseBeam():
                self._release(command)
            case Acknowledge():
                self._acknowledge(command, inputs)
            case CorrectBaseline():
                self._arming.budget.check_correction(command)
                self._controller.correct_baseline(command)
                self._measurer.correct_baseline(self._limits.prescribed_window.choices[0], self._limits.correction)
            case Countersign() | SignPosition():
                self._sign(command)
            case _:
                self._change(command)

    def _set_window(self, command: SetWindow) -> None:
        """Use another window on the same signals; per cent are converted at once where the range is known."""
        ranges = self._learner.learned_ranges(command.window.choices)
        self._controller.refuse_window_while_armed()
        if self._limits.current.needs_countersignature and not command.reason.strip():
            raise ReasonMissingError(say("another window for a patient needs a written reason at this site"))
        self._arming.budget.check_window(self._limits.changed(command, ranges).limits.window, command)
        self._controller.set_window(command, ranges)
        self._measurer.correct_baseline(self._limits.prescribed_window.choices[0], 0.0)
        self._follower.resolve_again()

    def _change(self, command: SetReference | SetWindow | Retrain | ApplyModel | ActivateModel) -> None:
        """Carry out a command that changes the reference, the window or the model."""
        match command:
            case SetWindow():
                self._set_window(command)
            case SetReference():
                self._set_reference(command)
            case Retrain():
                self._learner.retrain(keeps_reference=command.keeps_zero)
            case ApplyModel():
                if not self._learner.status.is_model_waiting:
                    raise CommandRefusedError(say("no new model waits to be applied"))
                self._disarm_for(say("a new model is applied"), command.operator)
                self._learner.apply_model()
            case ActivateModel():
                self._disarm_for(say("another model is activated"), command.operator)
                self._learner.activate(command.model)

    def _set_reference(self, command: SetReference) -> None:
        most_mm = None
        if self._learner.status.model is not None:
            self._controller.refuse_unseen_patient()  # no measured frame within a second: the learner drops the request
            self._refuse_other_move(command)
            self._refuse_other_level(command)
            most_mm = self._arming.budget.checked_mm(command)
        self._disarm_for(say("the reference is set"), command.operator)
        self._learner.set_reference(command.moment, most_mm=most_mm)
        self._arming.reference_by = command.operator
        self._limits.clear_correction()
        self._measurer.correct_baseline(self._limits.prescribed_window.choices[0], 0.0)
        self._supervisor.reset_position()

    def _refuse_other_move(self, command: SetReference) -> None:
        """Refuse to accept a movement of couch or camera that is not the one displayed."""
        moved = self._controller.room_change
        now_mm, seen_mm = 0.0 if moved is None else moved.by_mm, command.move_seen_mm or 0.0
        if abs(now_mm - seen_mm) <= MOVE_TOLERANCE_MM:
            return
        if moved is None:
            raise CommandRefusedError(say("no movement of couch or camera is seen by now: look again"))
        what = say("{text} has moved by {by_mm:.1f} mm since the reference", text=moved.mover.text, by_mm=moved.by_mm)
        if command.move_seen_mm is None:
            raise CommandRefusedError(say("{what}: confirm it with move_seen_mm", what=what))
        raise CommandRefusedError(say("{what}, not {seen_mm:.1f} mm: look again", what=what, seen_mm=seen_mm))

    def _refuse_other_level(self, command: SetReference) -> None:
        """Refuse a level that was not the one displayed, or that needs a reason and has none."""
        choice = self._limits.prescribed_window.choices[0]
        found = self._level(command.moment, choice)
        if command.level_seen is not None and (
            found.level is None or abs(found.level - command.level_seen) > LEVEL_TOLERANCE_MM * choice.per_mm
        ):
            now = (
                say("not known")
                if found.level is None
                else say("{level:.2f} {unit}", level=found.level, unit=choice.unit)
            )
            raise CommandRefusedError(
                say("the level is {now} by now, not {level_seen:g}: look again", now=now, level_seen=command.level_seen)
            )
        is_amplitude = any(isinstance(leaf, AmplitudeWindow) for leaf in self._limits.prescribed_window.leaves)
        is_at_an_end = found.percent is not None and not NEAR_EXHALE < found.percent < NEAR_INHALE
        if not is_amplitude or is_at_an_end or command.reason:
            return
        place = say("an unknown place") if found.percent is None else say("{percent:.0f} %", percent=found.percent)
        raise CommandRefusedError(
            say(
                "the level lies at {place} of the learned breath (0 % end of exhale, 100 % end of inhale): "
                "between {near_exhale:g} and {near_inhale:g} %, and where it is unknown, "
                "an amplitude window needs a reason",
                place=place,
                near_exhale=NEAR_EXHALE,
                near_inhale=NEAR_INHALE,
            )
        )

    def _level(self, moment: ReferenceMoment, choice: SignalChoice) -> _Level:
        """Return the level of a moment, and its place in the learned breathing range."""
        if moment is not ReferenceMoment.NOW:
            proposals = self._learner.status.reference_proposals
            one = next((one for one in proposals if one.moment is moment), None)
            if one is None:
                raise CommandRefusedError(say("fewer than two breaths are known: wait until the patient has breathed"))
            return _Level(one.level, one.percent)
        level, learned = self._controller.newest_level(choice), self._learner.learned_ranges((choice,)).get(choice)
        return _Level(level, None if level is None or learned is None else learned.percent(level))

    def _disarm_for(self, detail: str, operator: str) -> None:
        self._controller.decide(Ending(reason=HoldReason.DISARMED, detail=detail), cause=Cause(operator=operator))

    def _arm(self, command: Arm, inputs: CommandInputs) -> None:
        if self._follower.has_changed():  # armed with what is present now
            self._controller.rescale()
        self._follower.resolve_window()
        self._arming.refuse(
            command,
            self._controller.gate,
            operator_absence=inputs.operator_absence,
            is_watchdog_running=inputs.is_watchdog_running,
            refuse_old_frame=self._controller.refuse_without_fresh_signal,
        )
        signed = self._arming.signed
        self._line.rearm()
        if command.is_person:
            self._presence.note(command.operator)
        self._controller.decide(command, cause=Cause(operator=command.operator))
        if not self._controller.gate.is_armed:
            raise CommandRefusedError(say("a fault came up: {reason}", reason=self._controller.gate.reason))
        self._arming.budget.note_armed(command.operator, signed.signed_by)

    def _sign(self, command: Countersign | SignPosition) -> None:
        """Sign window and reference as a second person, or the patient's position."""
        if isinstance(command, SignPosition):
            self._arming.position.sign(command)
        elif not self._learner.status.has_reference or self._limits.is_window_unresolved:
            raise CountersignatureError(say("there is no reference yet, or the window has no edges yet: set it first"))
        else:
            self._arming.countersignature.sign(command, self._arming.state)
        self._controller.decide(cause=Cause(operator=command.operator))

    def _release(self, command: ReleaseBeam) -> None:
        if command.is_person:
            self._presence.note(command.operator)
        self._controller.release(command)

    def _acknowledge(self, command: Acknowledge, inputs: CommandInputs) -> None:
        if self._controller.gate.state is not GateState.FAULT:
            raise CommandRefusedError(say("there is no fault to acknowledge"))
        if inputs.queue_trouble is not None:
            raise CommandRefusedError(
                say("the fault persists ({queue_trouble}): nothing can be recorded", queue_trouble=inputs.queue_trouble)
            )
        self._controller.acknowledge(command)


def _is_of(measurement: Measurement, frame: RgbdFrame) -> bool:
    return (measurement.frame_index, measurement.timestamp_us, measurement.received_ns, measurement.missed_frames) == (
        frame.index,
        frame.timestamp_us,
        frame.received_ns,
        frame.missed_frames,
    )
