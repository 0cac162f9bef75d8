"""The plain method of the article on the benchmark's recording, timed like Tidegate: from decoded pictures onwards."""

import time

import numpy as np

from engine.calibration.camera_calibration import load_calibration
from engine.core.frames import FloatArray, RgbdFrame
from engine.lab.evaluation.methods.plain import ARTICLE_FPS, PlainReading
from engine.lab.performance.machine import SpeedBenchError
from engine.lab.performance.session import READ_TIMEOUT_S, EndlessSource, Recording

# The number of training frames does not change the cost of a frame.
TRAINING_FRAMES = 20
MAX_UNMEASURED = 100


class PlainSession:
    """Measures frames one by one, up to the reconstructed surface (equation 7)."""

    def __init__(self, recording: Recording) -> None:
        self._source = EndlessSource(recording)
        self._source.open()
        calibration = load_calibration(recording.calibration)
        self._reading = PlainReading(calibration, ARTICLE_FPS, training_frames=TRAINING_FRAMES)

    def learn(self) -> None:
        """Read frames until a model is fitted; raise SpeedBenchError if the four markers are never found."""
        for _ in range(TRAINING_FRAMES + MAX_UNMEASURED):
            self._measure(self._read())
            if self._reading.model is not None:
                return
        raise SpeedBenchError("the plain method never found its four markers")

    def block(self, frames: int) -> FloatArray:
        """Return the durations of ``frames`` frames [ns], shape (frames,)."""
        durations_ns = np.empty(frames)
        for number in range(frames):
            frame = self._read()
            started = time.perf_counter_ns()
            self._measure(frame)
            durations_ns[number] = time.perf_counter_ns() - started
        return durations_ns

    def close(self) -> None:
        """Close the recording."""
        self._source.close()

    def _read(self) -> RgbdFrame:
        return self._source.read(READ_TIMEOUT_S)

    def _measure(self, frame: RgbdFrame) -> None:
        measured = self._reading.measure(frame)
        if measured is not None and self._reading.model is not None:
            self._reading.model.reconstruct(measured.beta)
