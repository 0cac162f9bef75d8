"""A frame's way from the decoded pictures to the gate, whole and by stages, and the plain reading's beside it.

Every frame is decoded right before its way begins, as it is in a session: it comes fresh from the decoder, and the
decoder has used the caches for itself.
"""

import time
from dataclasses import dataclass

import numpy as np

from engine.evaluation.speed.decoding import PictureCost, time_decoding
from engine.evaluation.speed.figures import Timing, timing_of
from engine.evaluation.speed.machine import (
    SpeedBenchError,
    copy_bandwidth_bytes_s,
    set_memory_aside,
    settle_as_the_service,
)
from engine.evaluation.speed.plain import PlainSession
from engine.evaluation.speed.session import BenchSession, Recording
from engine.evaluation.speed.stages import PLACES, STAGES, TRAFFIC_PLACES, StageClock, TrafficMeter, replaced
from engine.frames import FloatArray, MeasurementState
from engine.training import InlineTrainer

MIN_MEASURED_SHARE = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSizes:
    """How much is timed: ``blocks`` of so many frames each, and decoded pictures of either kind."""

    blocks: int
    block_frames: int
    plain_frames: int
    decoded: int


@dataclass(frozen=True, slots=True, kw_only=True)
class StageCost:
    """One stage: its time, its part of all stages' medians, and what it must at least read and write [bytes]."""

    name: str
    timing: Timing
    share: float
    traffic_bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameCosts:
    """What a frame costs on one core.

    Attributes
    ----------
    whole, whole_cpu
        The whole way, unwrapped: by the clock, and by the processor time it took.
    stages
        Timed wrapped, in blocks of their own.
    plain
        The plain reading's way, from the decoded pictures to a surface of the region.
    bandwidth_bytes_s
        A large copy's, bytes read and bytes written.
    lost_core_share
        Share of the timed way in which somebody else had the core.
    """

    whole: Timing
    whole_cpu: Timing
    stages: tuple[StageCost, ...]
    plain: Timing
    decoding: tuple[PictureCost, ...]
    bandwidth_bytes_s: float
    lost_core_share: float

    @property
    def median_ratio(self) -> float:
        """How many times longer the plain reading takes, by the medians."""
        return self.plain.median_us / self.whole.median_us

    @property
    def p99_ratio(self) -> float:
        """How many times longer the plain reading takes, by the 99th percentiles."""
        return self.plain.p99_us / self.whole.p99_us


def time_frames(recording: Recording, sizes: FrameSizes, switch_interval_s: float) -> FrameCosts:
    """Time everything there is to a frame, in blocks that take turns; for a process of its own."""
    settle_as_the_service(switch_interval_s)
    ours = BenchSession(recording, InlineTrainer())
    ours.learn()
    plain = PlainSession(recording)
    plain.learn()
    set_memory_aside()
    _warm_up(ours, sizes.block_frames)
    walls, cpus, staged, plains = [], [], [], []
    for _ in range(sizes.blocks):
        ours.arm()
        wall_ns, cpu_ns = _whole_block(ours, sizes.block_frames)
        walls.append(wall_ns)
        cpus.append(cpu_ns)
        staged.append(_stage_block(ours, sizes.block_frames))
        plains.append(plain.block(sizes.plain_frames))
    traffic = _traffic(ours)
    ours.close()
    plain.close()
    return FrameCosts(
        whole=timing_of(walls),
        whole_cpu=timing_of(cpus),
        stages=_stage_costs(staged, traffic),
        plain=timing_of(plains),
        decoding=time_decoding(recording, sizes.decoded),
        bandwidth_bytes_s=copy_bandwidth_bytes_s(),
        lost_core_share=max(0.0, 1.0 - float(np.concatenate(cpus).sum() / np.concatenate(walls).sum())),
    )


def _warm_up(ours: BenchSession, frames: int) -> None:
    """Let the caches fill; refuse to time frames that go a shorter way."""
    measured = sum(ours.decide(ours.read()) is MeasurementState.MEASURING for _ in range(frames))
    if measured < MIN_MEASURED_SHARE * frames:
        msg = f"only {measured} of {frames} frames of the bench's recording are measured: there is nothing to time"
        raise SpeedBenchError(msg)


def _whole_block(ours: BenchSession, frames: int) -> tuple[FloatArray, FloatArray]:
    wall_ns, cpu_ns = np.empty(frames), np.empty(frames)
    for number in range(frames):
        frame = ours.read()
        cpu_started, started = time.thread_time_ns(), time.perf_counter_ns()
        ours.decide(frame)
        wall_ns[number] = time.perf_counter_ns() - started
        cpu_ns[number] = time.thread_time_ns() - cpu_started
    return wall_ns, cpu_ns


def _stage_block(ours: BenchSession, frames: int) -> FloatArray:
    """Time the stages of so many frames [ns], shape (frames, stages)."""
    clock = StageClock()
    with replaced(PLACES, clock.wrap):
        spent = []
        for _ in range(frames):
            ours.decide(ours.read())
            spent.append(clock.take_ns())
    return np.array(spent, dtype=np.float64)


def _traffic(ours: BenchSession) -> dict[str, int]:
    meter = TrafficMeter()
    with replaced(TRAFFIC_PLACES, meter.wrap):
        ours.decide(ours.read())
    return meter.bytes


def _stage_costs(blocks_ns: list[FloatArray], traffic: dict[str, int]) -> tuple[StageCost, ...]:
    timings = [timing_of([block[:, number] for block in blocks_ns]) for number in range(len(STAGES))]
    together_us = sum(timing.median_us for timing in timings)
    return tuple(
        StageCost(name=name, timing=timing, share=timing.median_us / together_us, traffic_bytes=traffic[name])
        for name, timing in zip(STAGES, timings, strict=True)
    )
