"""Figures of a bench by hand: round numbers, so that what is made of them can be reported in one's head."""

from dataclasses import replace

from lab.performance.frames import FrameCosts, FrameSizes, PictureCost
from lab.performance.machine import Machine, Timing
from lab.performance.memory import MemorySizes, MemoryUse
from lab.performance.results import SpeedFigures, SpeedSizes
from lab.performance.throughput import CommandRun, FitCost, FitSizes, FramesWhileFitting, Throughput

TINY = SpeedSizes(
    frames=FrameSizes(blocks=2, block_frames=15, plain_frames=3, decoded=5, peer_frames=1),
    fit=FitSizes(frames=60, fits=1, quiet_frames=6),
    memory=MemorySizes(session_s=14.0, warm_s=7.0, retrain_s=10.0),
    measure_runs=1,
)
"""Of everything so much that it is there at all."""


def took(median_us, *, p99_us=None):
    """A timing of this median."""
    tail_us = 2.0 * median_us if p99_us is None else p99_us
    return Timing(
        median_us=median_us, p99_us=tail_us, p999_us=3.0 * tail_us, max_us=4.0 * tail_us, samples=1000, blocks=4
    )


FRAMES = FrameCosts(
    to_gate=took(400.0, p99_us=800.0),
    whole=took(410.0, p99_us=1600.0),
    whole_cpu=took(390.0),
    numpy_cpu=took(1170.0),
    plain=took(16_000.0, p99_us=15_000.0),
    peer=took(200_000.0),
    decoding=(
        PictureCost(name="depth, 16zT", timing=took(300.0)),
        PictureCost(name="colour, JPEG", timing=took(2000.0)),
    ),
    numpy_decoding=(
        PictureCost(name="depth, 16zT", timing=took(900.0)),
        PictureCost(name="colour, JPEG", timing=took(2000.0)),
    ),
    lost_core_share=0.25,
    calls=240.0,
)

GOOD = SpeedFigures(
    machine=Machine(
        processor="Some Processor",
        caches="48K, 1024K",
        cores=(0, 1),
        memory_gb=8.0,
        system="Linux 6",
        python="3.11.7",
        numpy="2.4.6",
        opencv="5.0.0",
        frame_path="compiled 0123456789abcdef",
        load_average=0.1,
    ),
    sizes=TINY,
    frames=FRAMES,
    fit=FitCost(frames=450, fits=8, fit_s=0.2, job_s=1.0, longest_s=1.2),
    while_fitting=(
        FramesWhileFitting(
            cores=1, quiet=took(480.0, p99_us=1500.0), timing=took(500.0, p99_us=2000.0), fits=8, job_s=1.5
        ),
        FramesWhileFitting(
            cores=2, quiet=took(440.0, p99_us=1000.0), timing=took(450.0, p99_us=1500.0), fits=8, job_s=1.1
        ),
    ),
    throughput=(
        Throughput(name="one core", frames=1200, run=CommandRun(seconds=2.0, processor_s=1.6), steady_per_s=520.0),
        Throughput(name="two cores", frames=1200, run=CommandRun(seconds=1.0, processor_s=1.5), steady_per_s=750.0),
    ),
    memory=MemoryUse(
        session_s=120.0,
        warm_s=60.0,
        frames=3600,
        models=4,
        start_mb=200.0,
        end_mb=201.0,
        peak_start_mb=300.0,
        peak_end_mb=240.0,
        used_start_mb=100.0,
        used_end_mb=100.5,
    ),
    load_averages=(0.1, 1.0, 1.0),
)
"""A machine that reaches every mark."""


def slower(figures=GOOD, **frames):
    """Other figures of frames."""
    return replace(figures, frames=replace(figures.frames, **frames))
