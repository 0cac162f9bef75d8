"""A pipeline over the small scene, two breaths of which are repeated: fast, and with a known motion."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from functools import cache

from engine.core.breath import SignalChoice
from engine.core.clock import ManualClock
from engine.core.frames import Measurement, RgbdFrame
from engine.motion.learning.tasks import Outcome
from engine.motion.learning.trainer import InlineTrainer, Trainer, TrainingSettings
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from tests.support.motion import small_scene

CHOICES = (SignalChoice(), SignalChoice(signal="volume"), SignalChoice(signal="abdomen"))
SETTINGS = PipelineSettings(
    breath_signals=CHOICES,
    training=TrainingSettings(min_frames=40, min_seconds=4.0, min_cycles=1, max_seconds=20.0),
)
REPEATS = 240  # frames in two breaths of the scene


@cache
def scene_frames() -> tuple[RgbdFrame, ...]:
    """The frames of two breaths; drawn once per process."""
    return tuple(small_scene.frame(index) for index in range(REPEATS))


class SceneSession:
    """Measures the scene frame by frame; a frame's pictures may be replaced."""

    def __init__(
        self,
        frames: Sequence[RgbdFrame],
        settings: PipelineSettings = SETTINGS,
        trainer: Trainer[Outcome] | None = None,
    ) -> None:
        self.frames, self.index = frames, 0
        self.trainer = InlineTrainer() if trainer is None else trainer
        self.pipeline = Pipeline(small_scene.CALIBRATION, settings, ManualClock(), self.trainer)

    def next(self, **changes: object) -> Measurement:
        at_us = self.index * small_scene.FRAME_US
        frame = replace(
            self.frames[self.index % REPEATS],
            index=self.index,
            device_index=self.index + 1,
            timestamp_us=at_us,
            color_timestamp_us=at_us,
            received_ns=at_us * 1000,
            **changes,
        )
        self.index += 1
        return self.pipeline.measure(frame)

    def measure(self, count: int) -> list[Measurement]:
        return [self.next() for _ in range(count)]


@cache
def _measured(count: int) -> SceneSession:
    session = SceneSession(scene_frames())
    session.measure(count)
    return session


def session_after(count: int) -> SceneSession:
    """Return a session of its own that has measured so many frames; they are measured once per process."""
    measured = _measured(count)
    frames = measured.frames
    return deepcopy(measured, {id(frames): frames})
