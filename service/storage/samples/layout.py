"""The columns and the head of a sample file, `tidegate.samples/1`: one row per depth frame.

Each field's metadata contains its unit and meaning, so that a file can be read without this program. A value that could
not be measured is null; inside the two lists, whose cells have fixed places, it is NaN.

Convert the engine's frame records to a batch of samples.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pyarrow as pa

from engine.control import FrameRecord
from engine.core.breath import Breath
from engine.core.frames import Motion
from service.core.late_modules import when_loaded
from service.core.schemas.base import finite_or_none

SCHEMA_NAME = "tidegate.samples/1"
PREFIX = "tidegate."

# By name: a service without a session has no use for Arrow.
_CELLS = "list<element: float not null>"
_INT, _REAL, _TEXT, _TRUTH = "int64", "double", "string", "bool"
NO_CELLS = np.empty(0, dtype=np.float32)
NO_BREATH = Breath(phase_confidence=float("nan"))
NOT_MEASURED: dict[str, object] = dict.fromkeys(
    (
        *("whole_mm", "thorax_mm", "abdomen_mm", "volume_l", "residual_mm", "valid_share", "inlier_share"),
        *("region_rows", "regions_mm", "named_mm"),
    )
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One column: its type, its unit, and what it means."""

    name: str
    kind: str
    unit: str
    meaning: str
    is_optional: bool = True


def _always(name: str, kind: str, unit: str, meaning: str) -> Column:
    return Column(name=name, kind=kind, unit=unit, meaning=meaning, is_optional=False)


def _maybe(name: str, kind: str, unit: str, meaning: str) -> Column:
    return Column(name=name, kind=kind, unit=unit, meaning=meaning)


COLUMNS = (
    _always("frame_index", _INT, "1", "ordinal of the depth frame in its source, from 0"),
    _always("timestamp_us", _INT, "us", "the device's time of the depth frame"),
    _always("missed_frames", _INT, "1", "frames the device counted before this one and that never came"),
    _always("state", _TEXT, "", "training, measuring or lost"),
    _maybe("lost_reason", _TEXT, "", "why nothing was measured, or, while measuring, why the gate does not rest on it"),
    _maybe("whole_mm", _REAL, "mm", "motion of the whole region, positive towards the camera"),
    _maybe("thorax_mm", _REAL, "mm", "motion of the thorax"),
    _maybe("abdomen_mm", _REAL, "mm", "motion of the abdomen"),
    _maybe("volume_l", _REAL, "l", "volume against the reference"),
    _maybe("signal_mm", _REAL, "mm", "the gated signal (l where a volume is gated on)"),
    _maybe("residual_mm", _REAL, "mm", "largest mean misfit of a cell against the model"),
    _maybe("valid_share", _REAL, "1", "share of the region that the sensor saw"),
    _maybe("inlier_share", _REAL, "1", "share of the seen pixels that the model explains"),
    _always("gate", _TEXT, "", "disarmed, hold, dwell, beam_on or fault"),
    _maybe("hold_reason", _TEXT, "", "why the beam was held; null if and only if gate is beam_on"),
    _always("line_on", _TRUTH, "", "the beam line as read back, true also when it did not answer"),
    _maybe("captured_ns", _INT, "ns", "when the camera took the frame, on the host's monotonic clock"),
    _always("received_ns", _INT, "ns", "when the frame was in our hands, host monotonic"),
    _maybe("measured_ns", _INT, "ns", "when it had been measured, host monotonic"),
    _always("decided_ns", _INT, "ns", "when the gate had decided, host monotonic"),
    _always("asserted_ns", _INT, "ns", "when the command was at the beam line, host monotonic"),
    _maybe("phase_percent", _REAL, "%", "phase of the first followed signal, 0 at the end of inhale"),
    _maybe("phase_confidence", _REAL, "1", "confidence of the phase"),
    _maybe("rate_per_min", _REAL, "1/min", "breaths a minute"),
    _maybe("breath_amplitude", _REAL, "mm", "end of exhale to end of inhale (l where the signal is a volume)"),
    _maybe("breath_baseline", _REAL, "mm", "level of the end of exhale (l likewise)"),
    _maybe("breath_drift", _REAL, "mm", "how far the baseline is from where it was learned (l likewise)"),
    _maybe("region_rows", "int32", "1", "rows of the grid in regions_mm"),
    _maybe("regions_mm", _CELLS, "mm", "motion of each cell of the region grid, row by row, NaN where unknown"),
    _maybe("named_mm", _CELLS, "mm", "motion of the named regions in the order of the head, NaN where unknown"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleHead:
    """The head of a sample file; it names no patient, no plan and no person.

    ``utc`` and ``monotonic_ns`` are one moment on both clocks: the rows' times are monotonic.
    """

    session_id: str
    software: str = ""
    settings_sha256: str = ""
    calibration_sha256: str = ""
    model_id: str = ""
    regions: tuple[str, ...] = ()
    utc: str = ""
    monotonic_ns: int = 0

    def at(self, monotonic_ns: int | None) -> datetime | None:
        """Convert a monotonic time of the rows to UTC; None where either is not known."""
        if monotonic_ns is None or not self.utc:
            return None
        moment = datetime.fromisoformat(self.utc)
        return (moment + timedelta(microseconds=(monotonic_ns - self.monotonic_ns) / 1e3)).astimezone(UTC)

    @property
    def schema(self) -> pa.Schema:
        """The Arrow schema with this head in its metadata."""
        said = {f"{PREFIX}{field.name}": json.dumps(getattr(self, field.name)) for field in fields(self)}
        return pa.schema([_field(column) for column in COLUMNS], {f"{PREFIX}schema": SCHEMA_NAME, **said})


def head_of(metadata: Mapping[bytes, bytes]) -> SampleHead:
    """Read a file's head; raise ValueError where the file is not of this format."""
    said = {key.decode(): value.decode() for key, value in metadata.items()}
    if said.get(f"{PREFIX}schema") != SCHEMA_NAME:
        msg = f"not a file of {SCHEMA_NAME}"
        raise ValueError(msg)
    found: dict[str, Any] = {name: json.loads(said[f"{PREFIX}{name}"]) for name in SampleHead.__dataclass_fields__}
    return SampleHead(**{**found, "regions": tuple(found["regions"])})


def _call_in_one_thread() -> None:
    """Have Arrow work in the thread of each call, as the engine does (docs/1-start/architecture.md)."""
    pa.set_cpu_count(1)
    pa.set_io_thread_count(1)


when_loaded("pyarrow", _call_in_one_thread)


def _field(column: Column) -> pa.Field:
    is_list = column.kind == _CELLS
    return pa.field(
        column.name,
        pa.list_(pa.field("element", pa.float32(), nullable=False)) if is_list else column.kind,
        nullable=column.is_optional,
        metadata={"unit": column.unit, "meaning": column.meaning},
    )


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
