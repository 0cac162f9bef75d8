"""A session for the bench: a recording played over and over as one long one, and every frame's way to the gate."""

from dataclasses import dataclass, replace
from pathlib import Path

from engine.calibration import load_calibration
from engine.capture.oni_file import OniFileSource
from engine.capture.source import SourceDescription
from engine.clock import Clock, MonotonicClock
from engine.commands import Arm
from engine.errands import Outcome
from engine.errors import SourceEndedError
from engine.evaluation.speed.machine import SpeedBenchError
from engine.frames import MeasurementState, RgbdFrame
from engine.limits import GateLimits
from engine.pipeline import Pipeline, PipelineSettings
from engine.stages.gate import Gate, step_gate
from engine.training import Trainer, TrainingSettings
from engine.windows import amplitude_window

READ_TIMEOUT_S = 5.0
# Every breath of the volunteer is inside, so that the gate goes its longest way.
WINDOW = amplitude_window(lower_mm=-30.0, upper_mm=60.0)
LONGEST_GAP_PERIODS = 1.8
MOST_TO_LEARN = 4000


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """A volunteer's folder, and how to learn from it.

    Attributes
    ----------
    fps
        Nominal frame rate [1/s].
    training
        When a first model is fitted; small in tests.
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
        """The cameras' calibration."""
        return self.folder / "calibration.json"

    @property
    def limits(self) -> GateLimits:
        """The gate's: as they are by default at 30 frames a second, and as patient with a slower recording."""
        longest_gap_ms = 1000.0 * LONGEST_GAP_PERIODS / self.fps
        min_fps = max(min(20.0, self.fps / LONGEST_GAP_PERIODS), 5.0)
        return GateLimits(window=WINDOW, max_gap_ms=longest_gap_ms, min_fps=min_fps, is_played=True)


class EndlessSource:
    """A DepthSource over a recording that begins again when it is over, while numbers and times go on.

    Parameters
    ----------
    most_frames
        Where it ends after all; None is never.
    clock
        Stamps the frames; the host's by default.
    """

    def __init__(self, recording: Recording, *, most_frames: int | None = None, clock: Clock | None = None) -> None:
        self._period_us = round(1e6 / recording.fps)
        self._source = OniFileSource(recording.path, clock=clock or MonotonicClock(), is_helped=False)
        self._most_frames = most_frames
        self._index = 0
        self._shift_us: int | None = None
        self._last_us = -self._period_us

    def open(self) -> SourceDescription:
        """Open the recording at its beginning."""
        return self._source.open()

    def read(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame, decoded just now; raise SourceEndedError after ``most_frames``."""
        if self._index == self._most_frames:
            msg = f"over after {self._index} frames"
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
    """Measures and decides on frames one by one, as the engine's loop does."""

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
        self.pipeline = Pipeline(load_calibration(recording.calibration), settings, self._clock, trainer)
        self._source.open()

    def read(self) -> RgbdFrame:
        """Decode the next frame."""
        return self._source.read(READ_TIMEOUT_S)

    def decide(self, frame: RgbdFrame) -> MeasurementState:
        """Go a frame's way from the decoded pictures to the gate's decision."""
        measurement = self.pipeline.measure(frame)
        self._gate = step_gate(self._gate, measurement, self._clock.now_ns(), self._limits)
        return measurement.state

    def learn(self) -> None:
        """Play until frames are measured with a model, and arm the gate."""
        for _ in range(MOST_TO_LEARN):
            if self.decide(self.read()) is MeasurementState.MEASURING:
                self.arm()
                return
        msg = f"{MOST_TO_LEARN} frames were not enough to learn a motion model"
        raise SpeedBenchError(msg)

    def arm(self) -> None:
        """Arm a gate that knows of no fault: a frame in which a model was fitted was too old to be decided on."""
        self._gate = step_gate(Gate(), Arm(operator="bench"), self._clock.now_ns(), self._limits)

    @property
    def gate(self) -> Gate:
        """The gate as last decided."""
        return self._gate

    def close(self) -> None:
        """Close the recording."""
        self._source.close()
