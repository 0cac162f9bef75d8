"""Figures of a session's report, computed from its samples alone: the export is enough to compute them again."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from engine.core.clock import NS_PER_S
from service.core.schemas.reports import GatedMotion, HeldTime, Pulse, Range, ReportFigures
from service.storage.samples.figures import LONGEST_STEP_NS, Figures, hold_list

BASELINE_S = 30.0
BIN_US, BINS = 5_000, 41
FEWEST = 30
"""Frames with the beam on that a cell needs for a figure."""
SIGNALS = ("whole", "thorax", "abdomen")
NUMBERS = (
    *("decided_ns", "missed_frames", "whole_mm", "thorax_mm", "abdomen_mm", "signal_mm", "volume_l"),
    *("rate_per_min", "breath_amplitude", "breath_baseline"),
)
TEXTS = ("gate", "hold_reason", "state")


NO_CELLS = np.empty((0, 0, 0), dtype=np.float32)
NO_NAMED = np.empty((0, 0), dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class SampleColumns:
    """The columns that a report needs, one value a frame: numbers with NaN for null, texts with "" for null."""

    numbers: dict[str, npt.NDArray[np.float64]]
    texts: dict[str, npt.NDArray[np.object_]]
    decided_ns: npt.NDArray[np.int64]
    cells_on_mm: npt.NDArray[np.float32] = field(default_factory=lambda: NO_CELLS)
    """Motion of each cell of the region grid in the frames with the beam on, shape (frames, rows, columns) [mm]."""
    named_on_mm: npt.NDArray[np.float32] = field(default_factory=lambda: NO_NAMED)
    """Motion of each named region in the frames with the beam on, shape (frames, regions) [mm]."""

    @property
    def steps_s(self) -> npt.NDArray[np.float64]:
        """Time from each sample to the next, at most a second; 0 after the last [s]."""
        steps_ns = np.clip(np.diff(self.decided_ns, append=self.decided_ns[-1:]), 0, LONGEST_STEP_NS)
        return np.asarray(steps_ns / NS_PER_S)

    @property
    def seconds(self) -> npt.NDArray[np.float64]:
        """Time of each sample since the first [s]."""
        return np.asarray((self.decided_ns - self.decided_ns[:1]) / NS_PER_S)


def read_columns(batches: Iterable[pa.RecordBatch]) -> tuple[SampleColumns, Figures]:
    """Read the columns of a session, and count what is counted while it runs."""
    counted, read, cells = Figures(), list[pa.RecordBatch](), list[npt.NDArray[np.float32]]()
    named = list[npt.NDArray[np.float32]]()
    for batch in batches:
        counted.add(batch)
        read.append(batch.select([*NUMBERS, *TEXTS]))
        cells += _cells_on(batch)
        named += _named_on(batch)
    if not read:
        empty = np.empty(0)
        return (
            SampleColumns(dict.fromkeys(NUMBERS, empty), dict.fromkeys(TEXTS, empty.astype(object)), empty.astype(int)),
            counted,
        )
    table = pa.Table.from_batches(read)
    numbers = {
        name: np.asarray(table[name].cast(pa.float64()).to_numpy(zero_copy_only=False), dtype=np.float64)
        for name in NUMBERS
        if name != "decided_ns"
    }
    texts = {name: table[name].fill_null("").to_numpy(zero_copy_only=False) for name in TEXTS}
    cells_on_mm, named_on_mm = _alike(cells, NO_CELLS), _alike(named, NO_NAMED)
    return SampleColumns(numbers, texts, table["decided_ns"].to_numpy(), cells_on_mm, named_on_mm), counted


def _alike(parts: list[npt.NDArray[np.float32]], nothing: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Join the parts; a session has one grid, and frames of another one, from an older version, are left out."""
    return np.concatenate([one for one in parts if one.shape[1:] == parts[0].shape[1:]]) if parts else nothing


def _named_on(batch: pa.RecordBatch) -> list[npt.NDArray[np.float32]]:
    """Return the named regions' motion in the frames of a batch with the beam on, shape (frames, regions) [mm]."""
    on = batch.filter(pc.and_(pc.equal(batch["gate"], "beam_on"), pc.is_valid(batch["named_mm"])))
    values = on["named_mm"].flatten().to_numpy(zero_copy_only=False)
    return [values.reshape(on.num_rows, -1).astype(np.float32)] if len(values) else []


def _cells_on(batch: pa.RecordBatch) -> list[npt.NDArray[np.float32]]:
    """Return the cells' motion in the frames of a batch with the beam on, shape (frames, rows, columns) [mm]."""
    on = batch.filter(pc.and_(pc.equal(batch["gate"], "beam_on"), pc.is_valid(batch["region_rows"])))
    if on.num_rows == 0:
        return []
    rows = on["region_rows"][0].as_py()
    values = on["regions_mm"].flatten().to_numpy(zero_copy_only=False)
    is_a_grid = pc.all(pc.equal(on["region_rows"], rows)).as_py() and len(values) % (on.num_rows * rows) == 0
    return [values.reshape(on.num_rows, rows, -1).astype(np.float32)] if is_a_grid else []


def report_figures(columns: SampleColumns, counted: Figures, named: Sequence[str] = ()) -> ReportFigures:
    """Compute the figures of a report; ``named`` are the names of the named regions, in the samples' order."""
    gate, steps_s = columns.texts["gate"], columns.steps_s
    is_on, is_armed = gate == "beam_on", gate != "disarmed"
    armed_s, on_s = float(steps_s[is_armed].sum()), float(steps_s[is_on].sum())
    summary = counted.summary()
    first, last = _baselines(columns)
    rates = columns.numbers["rate_per_min"]
    motion = {signal: columns.numbers[f"{signal}_mm"][is_on] for signal in SIGNALS}
    if columns.named_on_mm.shape[1] == len(named):
        motion |= dict(zip(named, columns.named_on_mm.T.astype(np.float64), strict=True))
    return ReportFigures(
        frames=counted.frames,
        missed_frames=counted.missed_frames,
        lost=counted.lost,
        recorded_s=round(float(steps_s.sum()), 2),
        armed_s=round(armed_s, 2),
        beam_on_s=round(on_s, 2),
        duty_percent=round(100.0 * on_s / armed_s, 1) if armed_s > 0.0 else None,
        pulses=len(pulses := _pulses(columns)),
        pulse_s=_range(np.array([steps_s[start:end].sum() for start, end in beam_stretches(columns)]), 2),
        pulse_list=pulses,
        holds=_held(columns, steps_s),
        cells=_cells(columns.cells_on_mm),
        motion=[one for one in itertools.starmap(_motion, motion.items()) if one is not None],
        period_s=_range(60.0 / np.where(rates > 0.0, rates, np.nan), 2),
        amplitude=_range(columns.numbers["breath_amplitude"], 2),
        baseline_first=first,
        baseline_last=last,
        latency=summary.latency,
        latency_bins=_latency_bins(counted),
    )


def _latency_bins(counted: Figures) -> list[int]:
    """Count the frames by latency, in bins of `BIN_US`; the last has all that took longer."""
    shares = counted.latencies[: BIN_US * BINS].reshape(BINS, BIN_US).sum(axis=1)
    shares[-1] += counted.latencies[BIN_US * BINS :].sum()
    return [int(one) for one in shares]


def beam_stretches(columns: SampleColumns) -> npt.NDArray[np.intp]:
    """Return the first sample of each stretch with the beam on, and the first after it, shape (pulses, 2)."""
    is_on = columns.texts["gate"] == "beam_on"
    return np.flatnonzero(np.diff(np.concatenate(([False], is_on, [False])).astype(np.int8))).reshape(-1, 2)


def _pulses(columns: SampleColumns) -> list[Pulse]:
    steps_s, seconds, signal = columns.steps_s, columns.seconds, columns.numbers["signal_mm"]
    return [
        Pulse(
            from_s=round(float(seconds[start]), 2),
            to_s=round(float(seconds[min(end, len(seconds) - 1)]), 2),
            seconds=round(float(steps_s[start:end].sum()), 2),
            spread=round(float(np.ptp(known)), 2)
            if len(known := signal[start:end][np.isfinite(signal[start:end])])
            else None,
        )
        for start, end in beam_stretches(columns)
    ]


def _motion(signal: str, values: npt.NDArray[np.float64]) -> GatedMotion | None:
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return None
    mean = float(values.mean())
    return GatedMotion.model_validate(
        {
            "signal": signal,
            "mean_mm": round(mean, 2),
            "deviation_mm": round(float(values.std()), 2),
            "within_95_mm": round(float(np.percentile(np.abs(values - mean), 95.0)), 2),
            "frames": len(values),
        }
    )


def _cells(cells_on_mm: npt.NDArray[np.float32]) -> list[list[float | None]]:
    """Return for each cell within which distance of its own mean 95 % of the frames lie; None where too few saw it."""
    if len(cells_on_mm) == 0:
        return []
    _, rows, columns = cells_on_mm.shape
    return [[_within_95(cells_on_mm[:, row, column]) for column in range(columns)] for row in range(rows)]


def _within_95(values: npt.NDArray[np.float32]) -> float | None:
    known = values[np.isfinite(values)].astype(np.float64)
    if len(known) < FEWEST:
        return None
    return round(float(np.percentile(np.abs(known - known.mean()), 95.0)), 2)


def _held(columns: SampleColumns, steps_s: npt.NDArray[np.float64]) -> list[HeldTime]:
    """Count how often each reason held the armed gate, and for how long."""
    gate, reasons = columns.texts["gate"], columns.texts["hold_reason"]
    held = np.where((gate == "hold") | (gate == "fault"), reasons, "")
    begins = held != np.concatenate(([""], held[:-1])) if len(held) else held.astype(bool)
    counts = Counter(str(reason) for reason in held[begins & (held != "")])
    return [
        HeldTime(**dict(one), seconds=round(float(steps_s[held == one.reason].sum()), 2)) for one in hold_list(counts)
    ]


def _baselines(columns: SampleColumns) -> tuple[float | None, float | None]:
    values, seconds = columns.numbers["breath_baseline"], columns.seconds
    known = np.isfinite(values)
    if not known.any():
        return None, None
    values, seconds = values[known], seconds[known]
    first, last = values[seconds <= seconds[0] + BASELINE_S], values[seconds >= seconds[-1] - BASELINE_S]
    return round(float(np.median(first)), 2), round(float(np.median(last)), 2)


def _range(values: npt.NDArray[np.float64], digits: int) -> Range | None:
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return None
    median, low, high = (round(float(np.percentile(values, share)), digits) for share in (50.0, 5.0, 95.0))
    return Range(median=median, low=low, high=high)
