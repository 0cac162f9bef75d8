"""Convert the engine's frame records to a batch of samples."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from engine.control import FrameRecord
from engine.core.breath import Breath
from engine.core.frames import Motion
from service.core.finite import finite_or_none

NO_CELLS = np.empty(0, dtype=np.float32)
NO_BREATH = Breath(phase_confidence=float("nan"))


def batch_of(schema: pa.Schema, records: Sequence[FrameRecord]) -> pa.RecordBatch:
    """Put records into columns."""
    rows = [sample_values(record) for record in records]
    columns = [_column(field.type, [row[field.name] for row in rows]) for field in schema]
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def _column(kind: pa.DataType, values: list[Any]) -> pa.Array:
    if not pa.types.is_list(kind):
        return pa.array(values, kind)
    # Arrow converts a list of arrays cell by cell, which would be most of the cost of a sample.
    cells = [NO_CELLS if value is None else value for value in values]
    offsets = np.cumsum([0, *map(len, cells)], dtype=np.int32)
    missing = pa.array([value is None for value in values], pa.bool_())
    return pa.ListArray.from_arrays(offsets, np.concatenate([NO_CELLS, *cells]), type=kind, mask=missing)


def sample_values(record: FrameRecord) -> dict[str, object]:
    """Put a frame's record into the columns of `service.storage.samples.layout`."""
    measurement = record.measurement
    return {
        "frame_index": measurement.frame_index,
        "timestamp_us": measurement.timestamp_us,
        "missed_frames": measurement.missed_frames,
        "state": measurement.state.value,
        "lost_reason": None if measurement.reason is None else measurement.reason.reason.value,
        "signal_mm": finite_or_none(record.signal_mm),
        "gate": record.gate_state.value,
        "hold_reason": None if record.hold_reason is None else record.hold_reason.value,
        "line_on": record.line_on,
        "captured_ns": record.captured_ns,
        "received_ns": record.received_ns,
        "measured_ns": measurement.measured_ns,
        "decided_ns": record.decided_ns,
        "asserted_ns": record.asserted_ns,
        **_motion_values(measurement.motion),
        # The first signal whose breath is followed is the first one gated on.
        **_breath_values(measurement.breaths[0] if measurement.breaths else NO_BREATH),
    }


NOT_MEASURED: dict[str, object] = dict.fromkeys(
    (
        *("whole_mm", "thorax_mm", "abdomen_mm", "volume_l", "residual_mm", "valid_share", "inlier_share"),
        *("region_rows", "regions_mm", "named_mm"),
    )
)


def _motion_values(motion: Motion | None) -> dict[str, object]:
    if motion is None:
        return NOT_MEASURED
    return {
        "whole_mm": finite_or_none(motion.whole_mm),
        "thorax_mm": finite_or_none(motion.thorax_mm),
        "abdomen_mm": finite_or_none(motion.abdomen_mm),
        "volume_l": finite_or_none(motion.volume_l),
        "residual_mm": finite_or_none(motion.projection.residual_mm),
        "valid_share": finite_or_none(motion.projection.valid_share),
        "inlier_share": finite_or_none(motion.projection.inlier_share),
        "region_rows": motion.regions_mm.shape[0],
        "regions_mm": motion.regions_mm.astype(np.float32).ravel(),
        "named_mm": motion.named_mm.astype(np.float32) if len(motion.named_mm) else None,
    }


def _breath_values(breath: Breath) -> dict[str, object]:
    return {
        "phase_percent": finite_or_none(breath.phase_percent),
        "phase_confidence": finite_or_none(breath.phase_confidence),
        "rate_per_min": finite_or_none(breath.rate_per_min),
        "breath_amplitude": finite_or_none(breath.amplitude),
        "breath_baseline": finite_or_none(breath.baseline),
        "breath_drift": finite_or_none(breath.drift),
    }
