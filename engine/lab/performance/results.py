"""Values of the benchmark: the sizes of its parts, and their figures (the keys of ``bench.json``)."""

from dataclasses import dataclass

from engine.lab.performance.frames import FrameCosts, FrameSizes
from engine.lab.performance.learning import FitCost, FitSizes, FramesWhileFitting
from engine.lab.performance.machine import Machine
from engine.lab.performance.memory import MemorySizes, MemoryUse
from engine.lab.performance.throughput import Throughput


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedSizes:
    """Amount of work of each part."""

    frames: FrameSizes
    fit: FitSizes
    memory: MemorySizes
    measure_runs: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedFigures:
    """All figures; ``load_averages`` are the one-minute load averages before each part and at the end."""

    machine: Machine
    sizes: SpeedSizes
    frames: FrameCosts
    fit: FitCost
    while_fitting: tuple[FramesWhileFitting, ...]
    throughput: tuple[Throughput, ...]
    memory: MemoryUse
    load_averages: tuple[float, ...]
