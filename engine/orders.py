"""Carries out what people ask for: whether it may be now, the line first, and only then what was asked.

Owned by the engine thread, between two frames. What is refused is refused before anything is touched.
"""

from engine.beam.witnessed import AskedLine
from engine.commands import (
    Acknowledge,
    ActivateModel,
    ApplyModel,
    Arm,
    Command,
    CorrectBaseline,
    Disarm,
    HoldBeam,
    ReleaseBeam,
    Retrain,
    SetReference,
)
from engine.errors import CommandRefusedError
from engine.frame_pipeline import FramePipeline
from engine.frame_watch import FrameWatch
from engine.keeper import Cause, GateKeeper
from engine.limits import GateLimits
from engine.outbox import Outbox
from engine.permits import GateState, HoldReason
from engine.stages.gate import Ending
from engine.watchdog import Watchdog
from engine.witness import NOBODY, Seam, Witness


class Orders:
    """Obeys commands; and knows which model and zero the gate was armed with."""

    def __init__(
        self,
        *,
        pipeline: FramePipeline,
        beam: AskedLine,
        limits: GateLimits,
        keeper: GateKeeper,
        watch: FrameWatch,
        watchdog: Watchdog,
        outbox: Outbox,
        witness: Witness = NOBODY,
    ) -> None:
        self._pipeline, self._beam, self._limits = pipeline, beam, limits
        self._keeper, self._watch, self._watchdog, self._outbox = keeper, watch, watchdog, outbox
        self._witness = witness
        self._generation = pipeline.model_generation
        self._settled_zero: int | None = None

    def has_model_changed(self) -> bool:
        """Whether model or zero are others than at the last call, or at the last arming."""
        before, self._generation = self._generation, self._pipeline.model_generation
        return before != self._generation

    def settle_window(self) -> None:
        """Turn per cent into mm, once for every zero that is set.

        Another model behind the same zero has learned another range, where the patient lies by now: a window that took
        it would follow a drift that nobody has confirmed.
        """
        zero = self._pipeline.zero_number
        if self._settled_zero == zero or not self._limits.window.needs_ranges:
            return
        ranges = self._pipeline.learned_ranges(self._limits.window.choices)
        self._keeper.settle_window(ranges)
        if ranges:
            self._settled_zero = zero

    def obey(self, command: Command) -> None:
        """Carry a command out; raise a TidegateError where it is refused."""
        match command:
            case Arm():
                self._arm(command)
            case Disarm():
                self._keeper.disarm(command)
            case HoldBeam():
                self._keeper.hold(command)
            case ReleaseBeam():
                self._keeper.release(command)
            case Acknowledge():
                self._acknowledge(command)
            case CorrectBaseline():
                self._keeper.correct_baseline(command)
                self._pipeline.correct_baseline(self._limits.window.choices[0], self._keeper.correction)
            case _:
                self._change(command)

    def _change(self, command: SetReference | Retrain | ApplyModel | ActivateModel) -> None:
        """Obey what changes the zero or the model."""
        match command:
            case SetReference():
                self._set_reference(command)
            case Retrain():
                self._pipeline.retrain(keeps_zero=command.keeps_zero)
            case ApplyModel():
                self._apply_model(command)
            case ActivateModel():
                self._disarm_for("another model is activated", command.operator)
                self._pipeline.activate(command.model)

    def _set_reference(self, command: SetReference) -> None:
        self._disarm_for("the reference is set", command.operator)
        self._pipeline.set_reference()
        self._keeper.forget_correction()
        self._pipeline.correct_baseline(self._limits.window.choices[0], 0.0)
        self._watch.forget_position()

    def _apply_model(self, command: ApplyModel) -> None:
        if not self._pipeline.is_model_waiting:
            raise CommandRefusedError("no new model waits to be applied")
        self._disarm_for("a new model is applied", command.operator)
        self._pipeline.apply_model()

    def _disarm_for(self, detail: str, operator: str) -> None:
        self._keeper.decide(Ending(reason=HoldReason.DISARMED, detail=detail), cause=Cause(operator=operator))

    def _arm(self, command: Arm) -> None:
        self._generation = self._pipeline.model_generation
        self.settle_window()
        self._refuse_unless_ready()
        self._beam.rearm()
        self._keeper.watch_for(command.operator)
        self._keeper.decide(command, cause=Cause(operator=command.operator))
        if not self._keeper.gate.is_armed:
            raise CommandRefusedError(f"a fault came up: {self._keeper.gate.reason}")

    def _refuse_unless_ready(self) -> None:
        gate = self._keeper.gate
        if gate.state is GateState.FAULT:
            raise CommandRefusedError(f"a fault is latched ({gate.reason}): acknowledge it first")
        if gate.is_armed:
            raise CommandRefusedError("the gate is armed already")
        if self._pipeline.model is None:
            raise CommandRefusedError("there is no motion model yet: wait for the training to end")
        if self._pipeline.model_shortcoming is not None:
            raise CommandRefusedError(self._pipeline.model_shortcoming)
        if not self._pipeline.has_reference:
            raise CommandRefusedError("there is no reference yet: set it first")
        if self._keeper.is_window_unsettled:
            raise CommandRefusedError(
                "the window is told in per cent of a range that the model does not tell: learn again"
            )
        self._keeper.refuse_wide_window()
        if not self._witness.heard(Seam.WATCHDOG_WATCHES, lambda: self._watchdog.is_watching):
            raise CommandRefusedError("the watchdog does not run: this engine cannot be armed")
        self._keeper.refuse_without_fresh_signal()

    def _acknowledge(self, command: Acknowledge) -> None:
        if self._keeper.gate.state is not GateState.FAULT:
            raise CommandRefusedError("there is no fault to acknowledge")
        trouble = self._witness.heard(Seam.QUEUES, self._outbox.trouble)
        if trouble is not None:
            raise CommandRefusedError(f"the fault persists ({trouble}): nothing can be recorded")
        self._keeper.acknowledge(command)
