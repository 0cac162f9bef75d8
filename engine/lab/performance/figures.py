"""Statistics of measured times: medians over blocks, which other programs on the machine disturb least."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from engine.core.clock import NS_PER_S, NS_PER_US
from engine.core.frames import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """Statistics of many durations.

    Attributes
    ----------
    median_us, p99_us
        Median over the blocks of each block's median and 99th percentile [us].
    p999_us, max_us
        99.9th percentile and largest of all samples together [us].
    """

    median_us: float
    p99_us: float
    p999_us: float
    max_us: float
    samples: int
    blocks: int


def timing_of(blocks_ns: Sequence[FloatArray]) -> Timing:
    """Compute the statistics of blocks of durations [ns], shape (samples,) each; all NaN if there are none."""
    filled = [np.asarray(block, dtype=np.float64) / NS_PER_US for block in blocks_ns if len(block)]
    if not filled:
        nan = float("nan")
        return Timing(median_us=nan, p99_us=nan, p999_us=nan, max_us=nan, samples=0, blocks=0)
    everything = np.concatenate(filled)
    return Timing(
        median_us=float(np.median([np.median(block) for block in filled])),
        p99_us=float(np.median([np.percentile(block, 99.0) for block in filled])),
        p999_us=float(np.percentile(everything, 99.9)),
        max_us=float(everything.max()),
        samples=len(everything),
        blocks=len(filled),
    )


def frames_per_s(stamps_ns: FloatArray) -> float:
    """Mean rate of events at these times [1/s]; NaN for fewer than two."""
    if len(stamps_ns) < 2:
        return float("nan")
    return (len(stamps_ns) - 1) * NS_PER_S / float(stamps_ns[-1] - stamps_ns[0])
