"""What a session's frames took, from its own samples: each frame's times, the same for every version of the service."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow as pa

NS_PER_MS = 1e6
NS_PER_S = 1e9
NS_PER_US = 1e3
LATE_MS = 33.0

Times = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """A while of the run, by the host's monotonic clock [s]; ``kind`` is what went on: quiet, loaded, between."""

    kind: str
    begin_s: float
    end_s: float

    @property
    def seconds(self) -> float:
        """How long it was."""
        return self.end_s - self.begin_s


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameTimes:
    """Of the frames received in some blocks.

    Attributes
    ----------
    decision_ms
        From the frame's receipt to the decision.
    reported_ms
        From the camera (of a recording: the receipt) to the command at the line.
    late_ms
        How much later than its time a frame was received: of a player that is kept waiting.
    absent
        Frames that the recording has and the samples do not, within the blocks.
    missed
        Frames that the engine itself counted as missed.
    """

    decision_ms: Times
    reported_ms: Times
    late_ms: Times
    absent: int
    missed: int

    @property
    def count(self) -> int:
        """How many frames."""
        return len(self.decision_ms)

    @property
    def over(self) -> int:
        """How many took longer than a frame's time."""
        return int((self.decision_ms > LATE_MS).sum())

    @property
    def come_late(self) -> int:
        """How many were read more than a frame's time late: a camera would have lost some of these."""
        return int((self.late_ms > LATE_MS).sum())


def read_frames(exported: bytes) -> pa.Table:
    """Read what the service exported of a session."""
    return pa.ipc.open_stream(exported).read_all()


def times_in(table: pa.Table, blocks: list[Block]) -> FrameTimes:
    """Take the frames of some blocks out of a session."""
    index, received, decided, reported = (
        table[name].to_numpy() for name in ("frame_index", "received_ns", "decided_ns", "asserted_ns")
    )
    captured = _or(table["captured_ns"], received)
    due = table["timestamp_us"].to_numpy() * NS_PER_US
    late = received - due
    late = (late - late.min()) / NS_PER_MS
    inside = np.zeros(len(index), bool)
    absent = 0
    for block in blocks:
        chosen = (received >= block.begin_s * NS_PER_S) & (received < block.end_s * NS_PER_S)
        inside |= chosen
        # With the frame before the block, so that one lost at its edge counts too.
        first = max(int(np.argmax(chosen)) - 1, 0) if chosen.any() else 0
        numbers = np.concatenate([index[first : first + 1], index[chosen]])
        absent += int((np.diff(numbers) - 1).clip(0).sum())
    return FrameTimes(
        decision_ms=(decided - received)[inside] / NS_PER_MS,
        reported_ms=(reported - captured)[inside] / NS_PER_MS,
        late_ms=late[inside],
        absent=absent,
        missed=int(table["missed_frames"].to_numpy()[inside].sum()),
    )


def _or(column: pa.ChunkedArray, other: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return a column with another's values where it has none."""
    filled = column.fill_null(-1).to_numpy()
    return np.where(filled < 0, other, filled)
