"""Times the frame path from decoded pictures to the gate, as a whole and by stage, and the plain method's.

Every frame is decoded immediately before it is timed, as in a session, so that the caches are in the state that the
decoder leaves.
"""

import time
from dataclasses import dataclass

import numpy as np

from engine.core.compiled import numpy_forms
from engine.core.frames import FloatArray, MeasurementState
from engine.motion.learning.trainer import InlineTrainer
from engine.verification.performance.decoding import PictureCost, time_decoding
from engine.verification.performance.figures import Timing, timing_of
from engine.verification.performance.machine import (
    SpeedBenchError,
    copy_bandwidth_bytes_s,
    set_memory_aside,
    settle_as_the_service,
)
from engine.verification.performance.plain import PlainSession
from engine.verification.performance.session import BenchSession, Recording
from engine.verification.performance.stages import (
    STAGE_SITES,
    STAGES,
    TRAFFIC_SITES,
    StageClock,
    TrafficMeter,
    replaced,
)

MIN_MEASURED_SHARE = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSizes:
    """Amount of work: ``blocks`` of ``block_frames`` each, and ``decoded`` pictures of each kind."""

    blocks: int
    block_frames: int
    plain_frames: int
    decoded: int


@dataclass(frozen=True, slots=True, kw_only=True)
class StageCost:
    """One stage: time, share of the sum of the stages' medians, and least traffic to memory [bytes]."""

    name: str
    timing: Timing
    share: float
    traffic_bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameCosts:
    """Cost of a frame on one core.

    Attributes
    ----------
    whole, whole_cpu
        The whole frame path without wrappers: wall clock and processor time.
    numpy_cpu
        Processor time with the numpy forms of the compiled functions, in blocks between; equal where none is compiled.
    stages
        Stages, timed with wrappers in separate blocks.
    plain
        The plain method, from decoded pictures to a surface of the region.
    bandwidth_bytes_s
        Memory bandwidth of a large copy, bytes read plus bytes written [1/s].
    lost_core_share
        Share of the timed span in which other processes used the core, 0 to 1.
    """

    whole: Timing
    whole_cpu: Timing
    numpy_cpu: Timing
    stages: tuple[StageCost, ...]
    plain: Timing
    decoding: tuple[PictureCost, ...]
    numpy_decoding: tuple[PictureCost, ...]
    bandwidth_bytes_s: float
    lost_core_share: float

    @property
    def median_ratio(self) -> float:
        """Ratio of the plain method's median time to ours."""
        return self.plain.median_us / self.whole.median_us

    @property
    def compiled_ratio(self) -> float:
        """Ratio of the median processor time with the numpy forms to that of the path that runs."""
        return self.numpy_cpu.median_us / self.whole_cpu.median_us

    @property
    def p99_ratio(self) -> float:
        """Ratio of the plain method's 99th percentile to ours."""
        return self.plain.p99_us / self.whole.p99_us


def time_frames(recording: Recording, sizes: FrameSizes, switch_interval_s: float) -> FrameCosts:
    """Time frame path, stages and plain method in alternating blocks; run it in a process of its own."""
    settle_as_the_service(switch_interval_s)
    ours = BenchSession(recording, InlineTrainer())
    ours.learn()
    plain = PlainSession(recording)
    plain.learn()
    set_memory_aside()
    _warm_up(ours, sizes.block_frames)
    wall_blocks, cpu_blocks, numpy_blocks, stage_blocks, plain_blocks = [], [], [], [], []
    for _ in range(sizes.blocks):
        ours.arm()
        wall_ns, cpu_ns = _whole_block(ours, sizes.block_frames)
        wall_blocks.append(wall_ns)
        cpu_blocks.append(cpu_ns)
        with numpy_forms():
            numpy_blocks.append(_whole_block(ours, sizes.block_frames)[1])
        stage_blocks.append(_stage_block(ours, sizes.block_frames))
        plain_blocks.append(plain.block(sizes.plain_frames))
    traffic = _traffic(ours)
    ours.close()
    plain.close()
    with numpy_forms():
        numpy_decoding = time_decoding(recording, sizes.decoded)
    return FrameCosts(
        whole=timing_of(wall_blocks),
        whole_cpu=timing_of(cpu_blocks),
        numpy_cpu=timing_of(numpy_blocks),
        stages=_stage_costs(stage_blocks, traffic),
        plain=timing_of(plain_blocks),
        decoding=time_decoding(recording, sizes.decoded),
        numpy_decoding=numpy_decoding,
        bandwidth_bytes_s=copy_bandwidth_bytes_s(),
        lost_core_share=max(0.0, 1.0 - float(np.concatenate(cpu_blocks).sum() / np.concatenate(wall_blocks).sum())),
    )


def _warm_up(ours: BenchSession, frames: int) -> None:
    """Fill the caches; raise SpeedBenchError if too few frames are measured, as lost frames take a shorter path."""
    measured = sum(ours.decide(ours.read()) is MeasurementState.MEASURING for _ in range(frames))
    if measured < MIN_MEASURED_SHARE * frames:
        msg = f"only {measured} of {frames} frames of the bench's recording were measured, too few to time"
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
    """Return the stages' times of ``frames`` frames [ns], shape (frames, stages)."""
    clock = StageClock()
    with replaced(STAGE_SITES, clock.wrap):
        spent = []
        for _ in range(frames):
            ours.decide(ours.read())
            spent.append(clock.take_ns())
    return np.array(spent, dtype=np.float64)


def _traffic(ours: BenchSession) -> dict[str, int]:
    meter = TrafficMeter()
    with replaced(TRAFFIC_SITES, meter.wrap):
        ours.decide(ours.read())
    return meter.bytes


def _stage_costs(blocks_ns: list[FloatArray], traffic: dict[str, int]) -> tuple[StageCost, ...]:
    timings = [timing_of([block[:, number] for block in blocks_ns]) for number in range(len(STAGES))]
    together_us = sum(timing.median_us for timing in timings)
    return tuple(
        StageCost(name=name, timing=timing, share=timing.median_us / together_us, traffic_bytes=traffic[name])
        for name, timing in zip(STAGES, timings, strict=True)
    )
