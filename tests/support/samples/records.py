"""Records and files of samples, made by construction."""

from dataclasses import replace
from pathlib import Path

from engine.control.outputs import FrameRecord
from engine.core.breath import Breath
from engine.core.gate_state import GateState, HoldReason
from service.storage.samples.layout import SampleHead
from service.storage.samples.store import SampleStore
from service.storage.samples.stream import SampleStream
from tests.support.service.fake_engine import make_measurement

SESSION = "5e55" * 8
HEAD = SampleHead(
    session_id=SESSION,
    software="tidegate 0.1.0",
    settings_sha256="5" * 64,
    calibration_sha256="c" * 64,
    regions=("belly", "left"),
    utc="2026-11-21T03:00:00.000000Z",
    monotonic_ns=1_000,
)
PERIOD_NS = 33_370_000


def record(index: int, *, whole_mm: float | None = 1.5, gate: GateState = GateState.HOLD) -> FrameRecord:
    """One frame; every number tells which one it is."""
    received_ns = 1_000_000_000 + index * PERIOD_NS
    measurement = make_measurement(index, whole_mm=whole_mm, received_ns=received_ns)
    if whole_mm is not None:
        measurement = replace(measurement, breaths=(Breath(phase_percent=index % 100.0, rate_per_min=14.0),))
    return FrameRecord(
        measurement=measurement,
        gate_state=gate,
        hold_reason=None if gate is GateState.BEAM_ON else HoldReason.OUTSIDE_WINDOW,
        signal_mm=whole_mm,
        received_ns=received_ns,
        decided_ns=received_ns + 4_000_000,
        asserted_ns=received_ns + 5_000_000 + index * 1_000,
        line_on=gate is GateState.BEAM_ON,
        captured_ns=received_ns - 1_000_000 if index % 2 else None,
    )


def records(count: int, start: int = 0) -> list[FrameRecord]:
    """So many frames; every fifth is lost."""
    return [record(index, whole_mm=None if index % 5 == 4 else 0.1 * index) for index in range(start, start + count)]


def write_stream(folder: Path, rows: int = 40, *, a_batch: int = 8, is_finished: bool = True) -> SampleStream:
    """Write a session's stream as the writer does."""
    stream = SampleStore(folder).begin(HEAD)
    for start in range(0, rows, a_batch):
        stream.append(records(min(a_batch, rows - start), start))
        stream.sync()
    if is_finished:
        stream.finish()
    else:
        stream.release()
    return stream


def frames_of(shelf: SampleStore, session_id: str = SESSION) -> list[int]:
    """Which frames can be read."""
    return [index for batch in shelf.batches(session_id) for index in batch["frame_index"].to_pylist()]
