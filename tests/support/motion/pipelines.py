"""A pipeline with short settings, and frames played through it."""

from dataclasses import replace

from engine.core.clock import ManualClock
from engine.core.frames import MeasurementState
from engine.motion.learning.patient_match import PatientMatchLimits
from engine.motion.learning.trainer import InlineTrainer, TrainingSettings
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from tests.support.motion import small_scene

SETTINGS = PipelineSettings(
    training=TrainingSettings(min_frames=40, min_seconds=4.0, min_cycles=1, max_seconds=20.0),
    likeness=PatientMatchLimits(seconds=1.0),
)


def new_pipeline(trainer=None, settings=SETTINGS):
    return Pipeline(small_scene.CALIBRATION, settings, ManualClock(), InlineTrainer() if trainer is None else trainer)


class Played:
    """Frames one after the other, again and again, each with the time it would have."""

    def __init__(self, frames):
        self.frames, self.index, self.phase = frames, 0, 0

    def __next__(self):
        self.phase += 1
        return self.stamped(self.frames[(self.phase - 1) % len(self.frames)])

    def held(self, seed):
        """The patient as in the frame before, holding the breath."""
        return self.stamped(small_scene.frame(seed, excursion=small_scene.breath((self.phase - 1) % len(self.frames))))

    def stamped(self, shown):
        index = self.index
        self.index += 1
        return replace(
            shown,
            index=index,
            device_index=index + 1,
            timestamp_us=index * small_scene.FRAME_US,
            color_timestamp_us=index * small_scene.FRAME_US,
            received_ns=index * small_scene.FRAME_US * 1000,
            color=small_scene.numbered(shown.color, index),
        )


def measuring(learned, frames, trainer=None):
    """A pipeline that measures, and the camera it looks through."""
    pipeline, camera = new_pipeline(trainer), Played(frames)
    pipeline.learner.activate(learned)
    while pipeline.measure(next(camera)).state is not MeasurementState.MEASURING:
        assert camera.index < 400
    return pipeline, camera
