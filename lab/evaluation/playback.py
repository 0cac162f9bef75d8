"""Plays a recording through the live pipeline, frame by frame, for comparison with an instrument."""

from collections.abc import Iterator

from engine.calibration.camera_calibration import Calibration
from engine.capture.source import DepthSource
from engine.core.clock import ManualClock
from engine.core.errors import ModelError, SourceEndedError
from engine.core.frames import Measurement, RgbdFrame
from engine.motion.learning.trainer import InlineTrainer
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings

READ_TIMEOUT_S = 5.0


def decoded_frames(source: DepthSource) -> Iterator[RgbdFrame]:
    """Open a recording, yield every frame, and close it."""
    try:
        source.open()
        while True:
            try:
                yield source.read(READ_TIMEOUT_S)
            except SourceEndedError:
                return
    finally:
        source.close()


def play(
    source: DepthSource, calibration: Calibration, settings: PipelineSettings
) -> Iterator[tuple[RgbdFrame, Measurement]]:
    """Measure every frame once with inline training, so that a recording gives the same numbers on one processor.

    Raises
    ------
    RecordingError
        The recording cannot be read to its end.
    ModelError
        The recording ended before a motion model was learned.
    """
    pipeline = Pipeline(calibration, settings, ManualClock(), InlineTrainer())
    frames = 0
    for frame in decoded_frames(source):
        frames += 1
        yield frame, pipeline.measure(frame)
    if pipeline.learner.status.model is None:
        raise ModelError(f"{frames} frames were not enough to learn a motion model: nothing to compare")
