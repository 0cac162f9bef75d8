"""A recording played through the very pipeline that measures live, frame by frame, for an instrument to look on."""

from collections.abc import Iterator

from engine.calibration import Calibration
from engine.capture.source import DepthSource
from engine.clock import ManualClock
from engine.errors import ModelError, SourceEndedError
from engine.frames import Measurement, RgbdFrame
from engine.pipeline import Pipeline, PipelineSettings
from engine.training import InlineTrainer

READ_TIMEOUT_S = 5.0


def decoded_frames(source: DepthSource) -> Iterator[RgbdFrame]:
    """Open a recording, deliver every frame of it, and close it."""
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
    """Measure every frame once, learning in line, so that the same recording gives the same numbers.

    Raises
    ------
    RecordingError
        The recording cannot be read to its end.
    ModelError
        It ended before a motion model could be learned.
    """
    pipeline = Pipeline(calibration, settings, ManualClock(), InlineTrainer())
    frames = 0
    for frame in decoded_frames(source):
        frames += 1
        yield frame, pipeline.measure(frame)
    if pipeline.model is None:
        raise ModelError(f"{frames} frames were not enough to learn a motion model: nothing to compare")
