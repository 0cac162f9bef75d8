"""As much of a runner as the stream asks: frames are made as a test says, time is what it says."""

from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

from service.core.schemas.live_messages import Sample
from service.core.schemas.sessions import RecordingSource, Window
from service.engine_host.protocols import LiveFrame, SessionPlan
from service.sessions.alarms.board import AlarmBoard
from service.sessions.views.live import live_sample
from service.web.stream.encoding import Form, Frame, MessageEncoder, Shape, StreamClock
from service.web.stream.hub import LiveHub
from tests.support.service.api_calls import WINDOW, make_calibration
from tests.support.service.fake_engine import FakeRunning

JSON = Shape("websocket", Form.FULL)
THIN = Shape("websocket", Form.THIN)
EVENTS = Shape("sse", Form.FULL)


def utc_of(monotonic_ns: int) -> datetime:
    """Convert times of tests to UTC: zero is the beginning of 2026."""
    return datetime(2026, 1, 1, tzinfo=UTC) + timedelta(microseconds=monotonic_ns / 1000)


def sample(**update: Any) -> Sample:
    plan = SessionPlan(
        session_id="a" * 32,
        source=RecordingSource(kind="recording", path="a.oni"),
        recording=None,
        calibration=make_calibration(),
        window=Window.model_validate(WINDOW),
    )
    running = FakeRunning(plan)
    running.frame()
    made = live_sample(running.latest, plan, is_stopping=False, is_simulated_beam=True)
    return made.model_copy(update=update)


SAMPLE = sample()


@dataclass(eq=False)
class FakeRunner:
    """Gives out what it is set to."""

    frame: LiveFrame | None = None
    ns: int = 10_000_000_000
    now_s: float = 100.0
    camera: str | None = None
    failure: Exception | None = None
    fields: dict[str, Any] = field(default_factory=dict)
    alarms: AlarmBoard = field(default_factory=lambda: AlarmBoard(utc_of))

    def newest(self) -> LiveFrame | None:
        if self.failure is not None:
            raise self.failure
        return self.frame

    def now_ns(self) -> int:
        return self.ns

    def running_camera(self) -> str | None:
        return self.camera

    def come(self, index: int, **update: Any) -> LiveFrame:
        """Let a frame come, 5 ms after the camera took it and 2 ms ago."""
        self.fields |= update
        message = SAMPLE.model_copy(update={"frame_index": index, **self.fields})
        self.frame = LiveFrame(message=message, received_ns=self.ns - 2_000_000, captured_ns=self.ns - 7_000_000)
        return self.frame


def make_hub(runner: FakeRunner, **options: Any) -> LiveHub:
    chosen = {"max_clients": 300, "stall_s": 5.0, "now_s": lambda: runner.now_s, **options}
    return LiveHub(runner, runner.alarms, **chosen)


def make_frame(runner: FakeRunner, index: int, *, is_change: bool = False, missed: int = 0) -> Frame:
    clock = StreamClock(now_s=lambda: runner.now_s, now_ns=runner.now_ns)
    return Frame(
        runner.come(index),
        sequence=index,
        is_change=is_change,
        is_repeat=False,
        missed=missed,
        encoder=MessageEncoder(clock),
    )
