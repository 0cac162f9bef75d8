"""A session's figures, counted as its frames are written: asking often must not mean reading a long session again."""

from dataclasses import dataclass

from engine.frames import MeasurementState
from engine.live import FrameRecord
from engine.permits import GateState
from service import schemas


@dataclass(slots=True, kw_only=True)
class Figures:
    """Counts what has been written."""

    frames: int = 0
    missed_frames: int = 0
    lost: int = 0
    armed: int = 0
    on: int = 0
    transitions: int = 0

    def add(self, record: FrameRecord) -> None:
        """Count a frame; the same rules as `repository.summary` has for what is stored."""
        is_armed = record.gate_state is not GateState.DISARMED
        self.frames += 1
        self.missed_frames += record.measurement.missed_frames
        self.lost += record.measurement.state is MeasurementState.LOST
        self.armed += is_armed
        self.on += is_armed and record.line_on

    def summary(self, latency: schemas.LatencyView) -> schemas.Summary:
        """Tell the figures so far."""
        return schemas.Summary(
            frames=self.frames,
            missed_frames=self.missed_frames,
            lost=self.lost,
            duty_cycle=self.on / self.armed if self.armed else None,
            transitions=self.transitions,
            latency=latency,
        )
