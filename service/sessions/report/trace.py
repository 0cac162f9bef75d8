"""The trace of a session that is over, for a review: least and most of each signal over a part of it, and one moment.

A part is read at the scale at which it is drawn: an hour at 30 frames/s is as cheap to look at as ten seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from sqlalchemy import select

from engine.core.clock import NS_PER_S
from engine.core.errors import ModelError
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, FloatArray
from service.core.errors import BoundError, SessionStateError
from service.core.schemas.reports import SessionMoment, SessionTrace, SignalRange, TraceHold
from service.sessions.report.figures import SIGNALS
from service.sessions.report.reports import refuse_open
from service.storage.database import queries
from service.storage.database.engine import Database
from service.storage.database.tables import ModelRow
from service.storage.files.motion_models import ModelStore
from service.storage.samples.service import SampleService
from service.storage.samples.store import SampleStore

COLUMNS = ("decided_ns", "gate", "hold_reason", *(f"{signal}_mm" for signal in SIGNALS))
WINDOW = "outside_window"
"""The hold that is the gate's usual work: the trace itself shows it."""
HELD = ("hold", "fault")
DIGITS = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TraceSamples:
    """The drawn columns of a session, one value a frame; times since the first frame [s]."""

    times_s: npt.NDArray[np.float64]
    first_ns: int
    gates: npt.NDArray[np.object_]
    reasons: npt.NDArray[np.object_]
    motion_mm: dict[str, FloatArray]


class SessionTraces:
    """Reads parts and moments of sessions that are over."""

    def __init__(self, database: Database, store: SampleStore, models: ModelStore) -> None:
        self._database, self._store, self._models = database, store, models

    def part(self, session_id: str, from_s: float, to_s: float, points: int) -> SessionTrace:
        """Return the signals between two times since the first frame [s], in at most ``points`` ranges.

        Raises
        ------
        NotFoundError, SessionStateError, SamplesRemovedError
            As for a report.
        BoundError
            The part ends before it begins.
        """
        if to_s <= from_s:
            bound = f"above from_s, {from_s:g}"
            raise BoundError(f"to_s must be {bound}", field="to_s", value=f"{to_s:g}", bound=bound)
        samples = self._samples(session_id)
        return trace_part(session_id, samples, self._first_at(session_id, samples.first_ns), (from_s, to_s), points)

    def moment(self, session_id: str, at_s: float) -> SessionMoment:
        """Return the sample nearest to a time since the first frame, with the breathing surface [mm].

        Raises
        ------
        NotFoundError, SessionStateError, SamplesRemovedError
            As for a report.
        """
        times_s = self._samples(session_id).times_s
        if len(times_s) == 0:
            msg = "the session has no samples"
            raise SessionStateError(msg, field="session_id", value=session_id, bound="a session with samples")
        index = int(np.abs(times_s - at_s).argmin())
        row = self._store.row(session_id, index)
        (plain,) = row.drop_columns(["regions_mm", "named_mm"]).to_pylist()
        cells_mm = _cells(row)
        return SessionMoment(
            session_id=session_id,
            at_s=round(float(times_s[index]), DIGITS),
            **{name: plain[name] for name in ("frame_index", "gate", "hold_reason", "lost_reason")},
            **{name: _number(plain[name]) for name in (f"{signal}_mm" for signal in SIGNALS)},
            cells_mm=[_numbers(one) for one in cells_mm],
            surface_mm=self._surface(session_id, cells_mm),
        )

    def _samples(self, session_id: str) -> TraceSamples:
        with self._database.read() as db:
            row = queries.session_row(db, session_id)
            refuse_open(row)
            SampleService(self._database, self._store).refuse_removed(session_id, row.summary)
        read = [batch.select(list(COLUMNS)) for batch in self._store.batches(session_id, COLUMNS)]
        if not read:
            nothing = np.empty(0)
            return TraceSamples(
                times_s=nothing,
                first_ns=0,
                gates=nothing.astype(object),
                reasons=nothing.astype(object),
                motion_mm=dict.fromkeys(SIGNALS, nothing),
            )
        table = pa.Table.from_batches(read)
        decided_ns = table["decided_ns"].to_numpy()
        return TraceSamples(
            times_s=(decided_ns - decided_ns[0]) / NS_PER_S,
            first_ns=int(decided_ns[0]),
            gates=table["gate"].to_numpy(zero_copy_only=False),
            reasons=table["hold_reason"].fill_null("").to_numpy(zero_copy_only=False),
            motion_mm={
                name: np.asarray(table[f"{name}_mm"].to_numpy(zero_copy_only=False), dtype=np.float64)
                for name in SIGNALS
            },
        )

    def _first_at(self, session_id: str, first_ns: int) -> datetime | None:
        """Return the time of day of the first frame, from the moment that the head states on both clocks."""
        head = self._store.head(session_id)
        if head is None or not head.utc:
            return None
        return datetime.fromisoformat(head.utc) + timedelta(seconds=(first_ns - head.monotonic_ns) / NS_PER_S)

    def _surface(self, session_id: str, cells_mm: FloatArray) -> list[list[list[float] | None]]:
        """Move the nodes of the model's mean surface, its holes filled, by the motion of the cells around each."""
        with self._database.read() as db:
            newest = select(ModelRow.sha256).where(ModelRow.session_id == session_id).order_by(ModelRow.number.desc())
            sha256 = db.scalar(newest.limit(1))
        if sha256 is None or cells_mm.shape != (NODE_ROWS - 1, NODE_COLUMNS - 1):
            return []
        try:
            mean_mm = self._models.load(sha256).surface_mm
        except ModelError:
            return []
        if mean_mm is None or len(mean_mm) != NODE_ROWS * NODE_COLUMNS:
            return []
        nodes_mm = np.dstack(
            [_filled(one) for one in np.moveaxis(np.reshape(mean_mm, (NODE_ROWS, NODE_COLUMNS, 3)), 2, 0)]
        )
        nodes_mm[..., 2] -= _at_nodes(cells_mm)
        return [[one.round(2).tolist() if np.isfinite(one).all() else None for one in line] for line in nodes_mm]


def trace_part(
    session_id: str, samples: TraceSamples, first_at: datetime | None, part_s: tuple[float, float], points: int
) -> SessionTrace:
    """Return the signals in a part of a trace: the samples, or at most ``points`` ranges of equal length."""
    times_s = samples.times_s
    end_s = float(times_s[-1]) if len(times_s) else 0.0
    from_s, to_s = part_s[0], min(part_s[1], end_s + 1e-3)
    first, last = np.searchsorted(times_s, (from_s, max(to_s, from_s))).tolist()
    if last - first <= points:
        starts, step_s = np.arange(first, last), 0.0
    else:
        step_s = (to_s - from_s) / points
        starts = np.unique(np.searchsorted(times_s[:last], from_s + step_s * np.arange(points)))
        starts = starts[starts < last]
    extremes = {name: _extremes(samples.motion_mm[name][:last], starts) for name in SIGNALS}
    return SessionTrace(
        session_id=session_id,
        first_at=first_at,
        end_s=round(end_s, DIGITS),
        step_s=step_s,
        times_s=np.round(times_s[starts], DIGITS).tolist(),
        signals=[
            SignalRange(signal=name, low_mm=_numbers(low), high_mm=_numbers(high))
            for name, (low, high) in extremes.items()
        ],
        beams_s=[list(one) for one in _stretches(samples, samples.gates == "beam_on", from_s, to_s)],
        holds=list(_holds(samples, from_s, to_s)),
    )


def _at_nodes(cells_mm: FloatArray) -> FloatArray:
    """Return the mean of the known cells around each node, shape one larger in both directions [mm]."""
    wide = np.pad(cells_mm, 1, constant_values=np.nan)
    around = np.stack([wide[:-1, :-1], wide[:-1, 1:], wide[1:, :-1], wide[1:, 1:]])
    known = np.isfinite(around)
    total = np.where(known, around, 0.0).sum(axis=0)
    return np.asarray(np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan))


def _filled(values: FloatArray) -> FloatArray:
    """Fill what is not known with the mean of the known values beside it, from the edges of each hole inwards."""
    filled = np.array(values)
    while np.isnan(filled).any() and np.isfinite(filled).any():
        wide = np.pad(filled, 1, constant_values=np.nan)
        beside = np.stack([wide[:-2, 1:-1], wide[2:, 1:-1], wide[1:-1, :-2], wide[1:-1, 2:]])
        known = np.isfinite(beside)
        mean = np.where(known, beside, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        filled = np.where(np.isnan(filled) & known.any(axis=0), mean, filled)
    return filled


def _cells(row: pa.RecordBatch) -> FloatArray:
    """Return the motion of the cells in a sample, shape (rows, columns) [mm]; empty where nothing was measured."""
    rows, values = row["region_rows"][0].as_py(), row["regions_mm"][0].as_py()
    if not rows or not values or len(values) % rows:
        return np.empty((0, 0))
    return np.array(values).reshape(rows, -1)


def _extremes(values: FloatArray, starts: npt.NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
    """Return least and most of the values from each start to the next, NaN where none is known."""
    if len(starts) == 0:
        return np.empty(0), np.empty(0)
    return np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)


def _stretches(
    samples: TraceSamples, is_in: npt.NDArray[np.bool_], from_s: float, to_s: float
) -> list[tuple[float, float]]:
    """Return where a condition holds, from its first sample to the sample after its last, as far as it is in a part."""
    times_s = samples.times_s
    edges = np.flatnonzero(np.diff(np.concatenate(([False], is_in, [False])).astype(np.int8))).reshape(-1, 2)
    begin_s, end_s = times_s[edges[:, 0]], times_s[np.minimum(edges[:, 1], max(len(times_s) - 1, 0))]
    is_seen = (end_s >= from_s) & (begin_s <= to_s)
    pairs = zip(begin_s[is_seen].round(DIGITS).tolist(), end_s[is_seen].round(DIGITS).tolist(), strict=True)
    return list(pairs)


def _holds(samples: TraceSamples, from_s: float, to_s: float) -> list[TraceHold]:
    """Return the holds other than the window's, each with its beginning, its end and its reason."""
    found = []
    is_held = np.isin(samples.gates, HELD)
    for reason in sorted(set(samples.reasons[is_held]) - {WINDOW}):
        for gate in HELD:
            is_in = is_held & (samples.reasons == reason) & (samples.gates == gate)
            for begin_s, end_s in _stretches(samples, is_in, from_s, to_s):
                found.append(TraceHold(from_s=begin_s, to_s=end_s, gate=gate, reason=reason))
    return sorted(found, key=lambda one: one.from_s)


def _number(value: float | None) -> float | None:
    return None if value is None else round(value, DIGITS)


def _numbers(values: FloatArray) -> list[float | None]:
    """Return numbers for an answer; null stands for what is not known."""
    return [
        round(value, DIGITS) if is_known else None
        for value, is_known in zip(values.tolist(), np.isfinite(values).tolist(), strict=True)
    ]
