"""The breathing curve of a session that is over: what every export is made from."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from engine.core.clock import NS_PER_S, US_PER_S
from engine.core.frames import FloatArray
from service.core.errors import SessionStateError
from service.storage.samples.layout import SampleHead

BEAM_ON = "beam on"
SIGNALS = ("whole", "thorax", "abdomen")
COLUMNS = (
    "timestamp_us",
    "received_ns",
    "decided_ns",
    "gate",
    "hold_reason",
    "line_on",
    "phase_percent",
    *(f"{name}_mm" for name in SIGNALS),
)
LEAST = 2
"""Samples without which there is no rate."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """Frames in a row with something in common: from ``first`` to ``last``, both in it."""

    first: int
    last: int
    text: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BreathingCurve:
    """One value a recorded frame, n in all.

    Attributes
    ----------
    time_s
        The camera's time since the first frame [s], increasing.
    motion_mm
        ``whole``, ``thorax`` and ``abdomen`` [mm], inhale positive; NaN where not measured.
    phase
        Part of the breath since the end of inhale, 0 to 1; NaN where not known.
    gates, reasons
        State of the gate, and why it held; empty where the beam was on.
    is_on
        Whether the beam line read back on.
    begun_at
        Time of day of the first frame; None where it is not known.
    """

    time_s: npt.NDArray[np.float64]
    motion_mm: dict[str, FloatArray]
    phase: FloatArray
    gates: npt.NDArray[np.object_]
    reasons: npt.NDArray[np.object_]
    is_on: npt.NDArray[np.bool_]
    begun_at: datetime | None = None

    def places(self) -> tuple[npt.NDArray[np.int64], float]:
        """Return each frame's place on a scale of constant rate, from 0, and that rate [1/s].

        A frame keeps its own place; a place without a frame is one that never came. The rate is fitted, so that a
        camera at 30.03 frames a second does not run away from its places.
        """
        steps = np.diff(self.time_s)
        usual = float(np.median(steps))
        places = np.concatenate([[0], np.cumsum(np.maximum(np.rint(steps / usual), 1.0))]).astype(np.int64)
        return places, float(places[-1] / self.time_s[-1])

    def beams(self) -> Iterator[Stretch]:
        """Yield the stretches with the beam line on."""
        yield from (one for one in stretches(np.where(self.is_on, BEAM_ON, "")) if one.text)

    def holds(self) -> Iterator[Stretch]:
        """Yield the stretches in which the gate did not permit the beam, each with state and reason."""
        held = np.array(
            [
                "" if gate == "beam_on" else f"{gate}: {reason}" if reason and reason != gate else gate
                for gate, reason in zip(self.gates, self.reasons, strict=True)
            ],
            dtype=object,
        )
        yield from (one for one in stretches(held) if one.text)


def curve_of(session_id: str, batches: Iterable[pa.RecordBatch], head: SampleHead | None) -> BreathingCurve:
    """Make the curve of a session's samples (`COLUMNS` of them).

    Raises
    ------
    SessionStateError
        There are fewer than two samples.
    """
    read = [batch.select(list(COLUMNS)) for batch in batches]
    table = pa.Table.from_batches(read) if read else None
    if table is None or table.num_rows < LEAST:
        msg = "a session without samples has no breathing curve"
        raise SessionStateError(msg, field="session_id", value=session_id, bound=f"with at least {LEAST} samples")
    device_us, received_ns = (table[name].to_numpy() for name in ("timestamp_us", "received_ns"))
    is_sound = bool((np.diff(device_us) > 0).all())
    time_s = (device_us - device_us[0]) / US_PER_S if is_sound else (received_ns - received_ns[0]) / NS_PER_S
    keeps = np.concatenate([[True], np.diff(np.maximum.accumulate(time_s)) > 0.0])
    text = {name: table[name].fill_null("").to_numpy(zero_copy_only=False) for name in ("gate", "hold_reason")}
    number = {
        name: np.asarray(table[name].to_numpy(zero_copy_only=False), dtype=np.float64)
        for name in ("phase_percent", *(f"{signal}_mm" for signal in SIGNALS))
    }
    return BreathingCurve(
        time_s=time_s[keeps],
        motion_mm={name: number[f"{name}_mm"][keeps] for name in SIGNALS},
        phase=number["phase_percent"][keeps] / 100.0,
        gates=text["gate"][keeps],
        reasons=text["hold_reason"][keeps],
        is_on=table["line_on"].to_numpy(zero_copy_only=False)[keeps],
        begun_at=None if head is None else head.at(int(table["decided_ns"][0].as_py())),
    )


def stretches(texts: npt.NDArray[np.object_] | npt.NDArray[np.str_]) -> Iterator[Stretch]:
    """Yield the runs of equal texts."""
    ends = [*(np.flatnonzero(texts[1:] != texts[:-1])).tolist(), len(texts) - 1]
    first = 0
    for last in ends:
        yield Stretch(first=first, last=last, text=str(texts[first]))
        first = last + 1
