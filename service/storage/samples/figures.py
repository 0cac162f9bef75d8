"""A session's figures, counted as its samples are written, and the same way when they are read back.

One pass, in a memory that does not grow: latencies are counted in bins of a microsecond.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from engine.core.clock import NS_PER_MS, NS_PER_S
from engine.core.gate_state import HoldReason
from service.core.alarm_table import hold_text
from service.core.schemas import sessions

NS_PER_US = 1000
LONGEST_STEP_NS = NS_PER_S
"""Longest time counted between two samples with the line on; across a longer gap the gate's limits held the beam."""
MOST_US = 1_000_000
"""Latencies of a second and more share one bin; the maximum is exact."""


def _no_latencies() -> npt.NDArray[np.uint32]:
    return np.zeros(MOST_US + 1, dtype=np.uint32)


@dataclass(slots=True, kw_only=True)
class Figures:
    """Counts what has been written."""

    frames: int = 0
    missed_frames: int = 0
    lost: int = 0
    armed: int = 0
    on: int = 0
    on_ns: int = 0
    transitions: int = 0
    holds: Counter[str] = field(default_factory=Counter)
    slowest_ns: int = 0
    beam_offs_ms: list[float] = field(default_factory=list)
    latencies: npt.NDArray[np.uint32] = field(default_factory=_no_latencies, repr=False)
    _last: tuple[int, bool] | None = field(default=None, repr=False)

    def add(self, batch: pa.RecordBatch) -> None:
        """Count a batch of samples."""
        is_armed = _plain(pc.not_equal(batch["gate"], "disarmed"))
        self.frames += batch.num_rows
        self.missed_frames += int(_plain(batch["missed_frames"]).sum())
        self.lost += int(_plain(pc.equal(batch["state"], "lost")).sum())
        self.armed += int(is_armed.sum())
        self.on += int((is_armed & _plain(batch["line_on"])).sum())
        self._add_on_time(_plain(batch["decided_ns"]), _plain(batch["line_on"]).astype(np.bool_))
        self._add_latencies(
            _plain(batch["asserted_ns"]) - _plain(pc.coalesce(batch["captured_ns"], batch["received_ns"]))
        )

    def _add_on_time(self, decided_ns: npt.NDArray[np.int64], is_on: npt.NDArray[np.bool_]) -> None:
        """Add the time from each sample with the line on to the next one, also to the first of the next batch."""
        if len(decided_ns) == 0:
            return
        if self._last is not None:
            decided_ns = np.concatenate(([self._last[0]], decided_ns))
            is_on = np.concatenate(([self._last[1]], is_on))
        steps_ns = np.clip(np.diff(decided_ns), 0, LONGEST_STEP_NS)
        self.on_ns += int(steps_ns[is_on[:-1]].sum())
        self._last = int(decided_ns[-1]), bool(is_on[-1])

    def _add_latencies(self, latencies_ns: npt.NDArray[np.int64]) -> None:
        if len(latencies_ns):
            self.slowest_ns = max(self.slowest_ns, int(latencies_ns.max()))
            np.add.at(self.latencies, np.clip(latencies_ns // NS_PER_US, 0, MOST_US), 1)

    def summary(self, latency: sessions.LatencyView | None = None) -> sessions.Summary:
        """Return the figures so far; with the latencies counted here unless others are given."""
        return sessions.Summary(
            frames=self.frames,
            missed_frames=self.missed_frames,
            lost=self.lost,
            duty_cycle=self.on / self.armed if self.armed else None,
            beam_on_s=round(self.on_ns / NS_PER_S, 3),
            holds=hold_list(self.holds),
            transitions=self.transitions,
            latency=latency or self._latency(),
            beam_off=beam_off_summary(self.beam_offs_ms),
        )

    def _latency(self) -> sessions.LatencyView:
        if self.frames == 0:
            return sessions.LatencyView(p50_ms=None, p99_ms=None)
        return sessions.LatencyView(
            p50_ms=self._quantile_ms(0.50), p99_ms=self._quantile_ms(0.99), max_ms=self.slowest_ns / NS_PER_MS
        )

    def _quantile_ms(self, share: float) -> float:
        """Return the latency of the frame that has this share of all before it [ms]."""
        rank = min(int(share * self.frames), self.frames - 1)
        found_us = int(np.searchsorted(np.cumsum(self.latencies, dtype=np.int64), rank, side="right"))
        return min(found_us * NS_PER_US, self.slowest_ns) / NS_PER_MS


def hold_list(holds: Mapping[str, int]) -> list[sessions.HoldCount]:
    """List the reasons of holds, the most frequent first."""
    ordered = sorted(holds.items(), key=lambda one: (-one[1], one[0]))
    return [sessions.HoldCount(reason=reason, text=_text_of(reason), count=count) for reason, count in ordered]


def _text_of(reason: str) -> str:
    """Return the sentence of a reason; the reason itself if another version recorded it."""
    try:
        return hold_text(HoldReason(reason)) or reason
    except ValueError:
        return reason


def beam_off_summary(offs_ms: Sequence[float]) -> sessions.BeamOffSummary | None:
    """Summarise times from hold to beam off [ms]; None where none was measured."""
    if not offs_ms:
        return None
    return sessions.BeamOffSummary(
        holds=len(offs_ms),
        median_ms=float(np.median(offs_ms)),
        p95_ms=float(np.percentile(offs_ms, 95.0)),
        slowest_ms=max(offs_ms),
    )


def _plain(column: pa.Array) -> npt.NDArray[np.int64]:
    values: npt.NDArray[np.int64] = column.to_numpy(zero_copy_only=False)
    return values
