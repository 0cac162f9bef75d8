"""A patient in front of the coaching: frames of a running session, as the engine publishes them."""

from dataclasses import replace
from typing import Any

from engine.control.records import EngineStatus
from engine.core.breath import WHOLE
from engine.core.gate_state import GateState, HoldReason
from engine.core.learning_status import LearningStatus
from engine.core.signals import LearnedRange
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, ConditionState, GateWindow, HoldStage
from service.core.schemas.sessions import RecordingSource, Window
from service.engine_host.protocols import LiveFrame, SessionPlan
from service.sessions.views.live import live_sample
from tests.support.service.api_calls import WINDOW, make_calibration
from tests.support.service.fake_engine import FakeRunning

LEARNED = LearnedRange(low=0.0, high=10.0)
LEVEL = AmplitudeWindow(lower=14.0, upper=18.0, hysteresis=0.5)
HOLD = BreathHoldWindow(level=LEVEL, timeout_s=20.0)
EXHALE = AmplitudeWindow(lower=-1.0, upper=3.0, hysteresis=0.2)
FRAME_US = 33_370


class GuidedPatient:
    """Makes frames; the gate is armed and holds because of the window unless a test says otherwise."""

    def __init__(self, window: GateWindow = HOLD, session_id: str = "a" * 32) -> None:
        self.plan = SessionPlan(
            session_id=session_id,
            source=RecordingSource(kind="recording", path="a.oni"),
            recording=None,
            calibration=make_calibration(),
            window=Window.model_validate(WINDOW),
        )
        self.running = FakeRunning(self.plan)
        self.running.window = window
        self.running.learned_ranges = {WHOLE: LEARNED}
        self.arm()

    def arm(self) -> None:
        self.running.gate, self.running.reason = GateState.HOLD, HoldReason.OUTSIDE_WINDOW

    def disarm(self) -> None:
        self.running.gate, self.running.reason = GateState.DISARMED, HoldReason.DISARMED

    def frame(
        self,
        level_mm: float | None = 5.0,
        stage: HoldStage | None = None,
        *,
        at_s: float | None = None,
        held_since_s: float | None = None,
        status: str = "running",
        **changes: Any,
    ) -> LiveFrame:
        """Let a frame come; ``at_s`` is its device time, ``held_since_s`` when the breath hold had settled."""
        settled = {} if held_since_s is None else {"settled_at": 16.0, "held_since_us": int(held_since_s * 1e6)}
        self.running.conditions = () if stage is None else (ConditionState(stage=stage, **settled),)
        self.running.frame(whole_mm=level_mm)
        view = self.running.latest
        assert view is not None
        if at_s is not None:
            measurement = replace(view.record.measurement, timestamp_us=int(at_s * 1e6))
            view = replace(view, record=replace(view.record, measurement=measurement))
        view = self.running.latest = replace(view, **changes)
        message = live_sample(view, self.plan, is_stopping=False, is_simulated_beam=True)
        engine = EngineStatus(
            view=view,
            learning=LearningStatus(has_reference=self.running.has_reference),
            learned_ranges=self.running.learned_ranges,
        )
        return LiveFrame(
            message=message.model_copy(update={"session_status": status}),
            received_ns=view.record.received_ns,
            status=engine,
        )
