"""The plain reading of the article on the bench's recording, timed as Tidegate is: from decoded pictures onwards."""

import time

import numpy as np

from engine.calibration import load_calibration
from engine.evaluation.baseline import ARTICLE_FPS, PlainReading
from engine.evaluation.speed.machine import SpeedBenchError
from engine.evaluation.speed.session import READ_TIMEOUT_S, EndlessSource, Recording
from engine.frames import FloatArray, RgbdFrame

# What it learns from does not change what a frame costs it.
TRAINING_FRAMES = 20
MOST_UNSEEN = 100


class PlainSession:
    """Measures frames one by one, up to the reconstructed surface (equation 7)."""

    def __init__(self, recording: Recording) -> None:
        self._source = EndlessSource(recording)
        self._source.open()
        calibration = load_calibration(recording.calibration)
        self._reading = PlainReading(calibration, ARTICLE_FPS, training_frames=TRAINING_FRAMES)

    def learn(self) -> None:
        """Play until there is a model."""
        for _ in range(TRAINING_FRAMES + MOST_UNSEEN):
            self._measure(self._read())
            if self._reading.model is not None:
                return
        raise SpeedBenchError("the plain reading never saw its four dots")

    def block(self, frames: int) -> FloatArray:
        """Time so many frames [ns]."""
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
