"""Statistics of one engine's frames: count, rate and latency."""

from collections import deque

import numpy as np

from engine.control.outputs import LatencySummary
from engine.core.clock import NS_PER_MS, NS_PER_S

LATENCY_SAMPLES = 512
FRAMES_PER_SUMMARY = 8
"""Percentiles are computed once in this many frames: sorting at every frame would add latency."""


class LatencyStatistics:
    """Running statistics; owned by the engine thread."""

    def __init__(self, *, warn_latency_ms: float) -> None:
        self._warn_latency_ms = warn_latency_ms
        self.frames = 0
        self.missed_frames = 0
        self._received_ns: deque[int] = deque()
        self._latencies_ms: deque[float] = deque(maxlen=LATENCY_SAMPLES)
        self._p50_ms = self._p99_ms = self._max_ms = 0.0

    def count(self, *, captured_ns: int, received_ns: int, asserted_ns: int, missed_frames: int) -> None:
        """Count one frame."""
        latency_ms = (asserted_ns - captured_ns) / NS_PER_MS
        self._latencies_ms.append(latency_ms)
        self._max_ms = max(self._max_ms, latency_ms)
        if self.frames % FRAMES_PER_SUMMARY == 0:
            p50_ms, p99_ms = np.percentile(self._latencies_ms, [50, 99])
            self._p50_ms, self._p99_ms = float(p50_ms), float(p99_ms)
        self.frames += 1
        self.missed_frames += max(missed_frames, 0)
        self._received_ns.append(received_ns)
        while received_ns - self._received_ns[0] > NS_PER_S:
            self._received_ns.popleft()

    @property
    def fps(self) -> float:
        """Frames a second over the last second; 0 until there are two."""
        span_ns = self._received_ns[-1] - self._received_ns[0] if self._received_ns else 0
        return 0.0 if span_ns <= 0 else (len(self._received_ns) - 1) * NS_PER_S / span_ns

    @property
    def latency(self) -> LatencySummary:
        """Latency of the last frame, of the last few hundred, and the longest so far."""
        last_ms = self._latencies_ms[-1] if self._latencies_ms else 0.0
        return LatencySummary(
            last_ms=last_ms,
            p50_ms=self._p50_ms,
            p99_ms=self._p99_ms,
            max_ms=self._max_ms,
            is_warned=last_ms > self._warn_latency_ms,
        )
