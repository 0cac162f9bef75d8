"""A session for the benchmark: a recording repeated as one long one, measured and gated frame by frame.

The benchmark's recording: made once in a folder, and reused if it is complete and its recipe is unchanged.
"""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from engine.calibration.camera_calibration import load_calibration
from engine.capture.recording_source import OniFileSource
from engine.capture.source import SourceDescription
from engine.core.clock import Clock, MonotonicClock
from engine.core.commands import Arm
from engine.core.errors import SourceEndedError
from engine.core.frames import MeasurementState, RgbdFrame
from engine.gating.gate import Gate, step_gate
from engine.gating.limits import GateLimits
from engine.gating.windows import amplitude_window
from engine.motion.learning.tasks import Outcome
from engine.motion.learning.trainer import Trainer, TrainingSettings
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from engine.offline.result_files import fingerprint
from lab.evaluation.runs.datasets import is_made, write_recipe
from lab.performance.machine import SpeedBenchError
from lab.phantom.recording import make_volunteer

READ_TIMEOUT_S = 5.0
# Wider than every breath of the volunteer, so that the gate takes its longest path.
WINDOW = amplitude_window(lower_mm=-30.0, upper_mm=60.0)
LONGEST_GAP_PERIODS = 1.8
MAX_TRAINING_FRAMES = 4000
SCENARIO, VOLUNTEER, SEED, FPS = "regular", 1, 1, 30.0
FOLDER = "speed-recording"


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """A volunteer's folder, and the training settings.

    Attributes
    ----------
    fps
        Nominal frame rate [1/s].
    training
        When the first model is fitted; smaller in tests.
    """

    folder: Path
    fps: float = 30.0
    training: TrainingSettings

    @property
    def path(self) -> Path:
        """The ``.oni`` file."""
        return self.folder / "recording.oni"

    @property
    def calibration(self) -> Path:
        """Path of the calibration file."""
        return self.folder / "calibration.json"

    @property
    def limits(self) -> GateLimits:
        """Limits of the gate: the defaults at 30 frames/s, with the frame gap widened for a slower recording."""
        longest_gap_ms = 1000.0 * LONGEST_GAP_PERIODS / self.fps
        min_fps = max(min(20.0, self.fps / LONGEST_GAP_PERIODS), 5.0)
        return GateLimits(window=WINDOW, max_gap_ms=longest_gap_ms, min_fps=min_fps, is_played=True)


class EndlessSource:
    """A `DepthSource` that repeats a recording; frame numbers and times keep increasing.

    Parameters
    ----------
    most_frames
        Number of frames after which it ends; None for never.
    clock
        Stamps the frames; the host's monotonic clock by default.
    """

    def __init__(self, recording: Recording, *, most_frames: int | None = None, clock: Clock | None = None) -> None:
        self._period_us = round(1e6 / recording.fps)
        self._source = OniFileSource(recording.path, clock=clock or MonotonicClock(), is_helped=False)
        self._most_frames = most_frames
        self._index = 0
        self._shift_us: int | None = None
        self._last_us = -self._period_us

    def open(self) -> SourceDescription:
        """Open the recording at its first frame."""
        return self._source.open()

    def read(self, timeout_s: float) -> RgbdFrame:
        """Decode and return the next frame; raise SourceEndedError after ``most_frames``."""
        if self._index == self._most_frames:
            msg = f"ended after {self._index} frames"
            raise SourceEndedError(msg)
        try:
            frame = self._source.read(timeout_s)
        except SourceEndedError:
            self._source.open()
            self._shift_us = None
            frame = self._source.read(timeout_s)
        if self._shift_us is None:
            self._shift_us = self._last_us + self._period_us - frame.timestamp_us
        self._last_us = frame.timestamp_us + self._shift_us
        self._index += 1
        return replace(
            frame,
            index=self._index - 1,
            device_index=self._index,
            timestamp_us=self._last_us,
            color_timestamp_us=frame.color_timestamp_us + self._shift_us,
        )

    def close(self) -> None:
        """Close the recording."""
        self._source.close()


class BenchSession:
    """Measures and gates frames one by one, as the engine's loop does."""

    def __init__(
        self,
        recording: Recording,
        trainer: Trainer[Outcome],
        *,
        training: TrainingSettings | None = None,
        clock: Clock | None = None,
    ) -> None:
        settings = PipelineSettings(training=recording.training if training is None else training)
        self._clock = clock or MonotonicClock()
        self._source = EndlessSource(recording, clock=self._clock)
        self._limits = recording.limits
        self._gate = Gate()
        calibration = load_calibration(recording.calibration)
        self.pipeline = Pipeline(calibration, settings, self._clock, trainer, learns_after=True)
        self._source.open()

    def read(self) -> RgbdFrame:
        """Decode the next frame."""
        return self._source.read(READ_TIMEOUT_S)

    def decide(self, frame: RgbdFrame) -> MeasurementState:
        """Measure a decoded frame and step the gate; return the measurement's state."""
        measurement = self.pipeline.measure(frame)
        self._gate = step_gate(self._gate, measurement, self._clock.now_ns(), self._limits)
        return measurement.state

    def go_on(self) -> None:
        """Do what the decision did not wait for."""
        self.pipeline.learn()

    def learn(self, wait: Callable[[], object] = lambda: None) -> None:
        """Process frames until the first one is measured with a model, then arm the gate; ``wait`` follows each."""
        for _ in range(MAX_TRAINING_FRAMES):
            if self.decide(self.read()) is MeasurementState.MEASURING:
                self.arm()
                return
            wait()
        msg = f"{MAX_TRAINING_FRAMES} frames were not enough to learn a motion model"
        raise SpeedBenchError(msg)

    def arm(self) -> None:
        """Arm a new gate: the frame during which a model was fitted inline has latched a fault in the old one."""
        self._gate = step_gate(Gate(), Arm(operator="bench"), self._clock.now_ns(), self._limits)

    @property
    def gate(self) -> Gate:
        """State of the gate after the last frame."""
        return self._gate

    def close(self) -> None:
        """Close the recording."""
        self._source.close()


def make_recording(work: Path, seconds: float, on_progress: Callable[[int, int], None]) -> Path:
    """Return the recording's folder within ``work``; make it if it is missing, incomplete or of another recipe."""
    folder = work / FOLDER
    recipe: dict[str, object] = {
        "scenario": SCENARIO,
        "volunteer": VOLUNTEER,
        "seed": SEED,
        "seconds": seconds,
        "fps": FPS,
        "phantom": fingerprint("lab/phantom/*.py"),
    }
    if is_made(folder, recipe):
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    make_volunteer(
        SCENARIO, volunteer=VOLUNTEER, seconds=seconds, fps=FPS, seed=SEED, out=folder, on_progress=on_progress
    )
    write_recipe(folder, recipe)
    return folder
