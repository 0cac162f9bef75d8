"""The whole of the bench, part by part, and what is kept of it."""

import json
import math
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from engine import __version__
from engine.errors import InvalidValueError
from engine.evaluation.speed.frames import FrameCosts, FrameSizes, time_frames
from engine.evaluation.speed.learning import (
    FitCost,
    FitSizes,
    FramesWhileFitting,
    time_fits,
    time_frames_while_fitting,
)
from engine.evaluation.speed.machine import Machine, on_cores, this_machine
from engine.evaluation.speed.marks import SpeedMark
from engine.evaluation.speed.memory import MemorySizes, MemoryUse, watch_memory
from engine.evaluation.speed.session import Recording
from engine.evaluation.speed.throughput import CommandRun, RunCommand, Throughput, measure_by_command, steady_rate
from engine.oni.reader import describe
from engine.whole_files import write_whole

SCHEMA = "tidegate.speed/1"
JSON_NAME = "bench.json"
MEMORY_MINUTES = (2.0, 600.0)
WARM_S = 60.0
RETRAIN_S = 20.0


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedSizes:
    """How much is done of everything."""

    frames: FrameSizes
    fit: FitSizes
    memory: MemorySizes
    measure_runs: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedFigures:
    """All that was measured; ``load_averages`` are the last minute's, before each part and at the end."""

    machine: Machine
    sizes: SpeedSizes
    frames: FrameCosts
    fit: FitCost
    while_fitting: tuple[FramesWhileFitting, ...]
    throughput: tuple[Throughput, ...]
    memory: MemoryUse
    load_averages: tuple[float, ...]


def full_sizes(memory_minutes: float) -> SpeedSizes:
    """Return how much the whole bench does."""
    return SpeedSizes(
        frames=FrameSizes(blocks=8, block_frames=400, plain_frames=80, decoded=600),
        fit=FitSizes(frames=450, fits=8),
        memory=_memory_sizes(memory_minutes),
        measure_runs=3,
    )


def quick_sizes(memory_minutes: float) -> SpeedSizes:
    """Return how much a quick look does."""
    return SpeedSizes(
        frames=FrameSizes(blocks=3, block_frames=200, plain_frames=30, decoded=200),
        fit=FitSizes(frames=450, fits=2),
        memory=_memory_sizes(memory_minutes),
        measure_runs=1,
    )


def _memory_sizes(minutes: float) -> MemorySizes:
    low, high = MEMORY_MINUTES
    if not low <= minutes <= high:
        raise InvalidValueError("memory_minutes", minutes, f"from {low:g} to {high:g}")
    return MemorySizes(session_s=60.0 * minutes, warm_s=WARM_S, retrain_s=RETRAIN_S)


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedBench:
    """What the bench needs beside its sizes.

    Attributes
    ----------
    work
        Folder for what the batch runs write; nothing stays there.
    run_command
        Runs ``tidegate measure`` as a user would.
    on_part
        Called with the name of each part as it begins.
    switch_interval_s
        How soon the service lets a waiting thread have the interpreter [s].
    """

    recording: Recording
    work: Path
    run_command: RunCommand
    on_part: Callable[[str], None]
    switch_interval_s: float

    def run(self, sizes: SpeedSizes) -> SpeedFigures:
        """Measure everything, one part after another.

        Raises
        ------
        SpeedBenchError
            A part could not be done.
        """
        machine, loads = this_machine(), list[float]()

        def begin(part: str) -> None:
            loads.append(os.getloadavg()[0])
            self.on_part(part)

        one = (machine.cores[-1],)
        begin("a frame's way")
        frames = on_cores(one, time_frames, self.recording, sizes.frames, self.switch_interval_s)
        begin("fits")
        fit = on_cores(one, time_fits, self.recording, sizes.fit, self.switch_interval_s)
        beside = []
        for cores in filter(None, (one, machine.pairs)):
            begin("frames while fitting")
            work = time_frames_while_fitting
            beside.append(on_cores(cores, work, self.recording, sizes.fit, len(cores), self.switch_interval_s))
        begin("recordings from disk")
        throughput = self._throughput(machine, sizes.measure_runs)
        begin("memory")
        memory = on_cores(machine.pairs or one, watch_memory, self.recording, sizes.memory, self.switch_interval_s)
        loads.append(os.getloadavg()[0])
        return SpeedFigures(
            machine=machine,
            sizes=sizes,
            frames=frames,
            fit=fit,
            while_fitting=tuple(beside),
            throughput=throughput,
            memory=memory,
            load_averages=tuple(round(load, 2) for load in loads),
        )

    def _throughput(self, machine: Machine, runs: int) -> tuple[Throughput, ...]:
        frames = describe(self.recording.path).depth_frames
        path, one = self.recording.path, (machine.cores[-1],)

        def by_command(recordings: list[Path], cores: tuple[int, ...], jobs: int) -> CommandRun:
            return measure_by_command(recordings, cores, jobs, runs=runs, work=self.work, run_command=self.run_command)

        rows = [("one core", one), *([] if machine.pairs is None else [("two cores", machine.pairs)])]
        done = [
            Throughput(
                name=name,
                frames=frames,
                run=by_command([path], cores, 1),
                steady_per_s=on_cores(cores, steady_rate, self.recording, self.work),
            )
            for name, cores in rows
        ]
        if machine.pairs is not None:
            name = "two cores, two recordings at once (--jobs 2)"
            run = by_command([path, path], machine.pairs, 2)
            done.append(Throughput(name=name, frames=2 * frames, run=run, steady_per_s=None))
        return tuple(done)


def write_figures(figures: SpeedFigures, marks: list[SpeedMark], out: Path, *, command: str) -> Path:
    """Write ``bench.json``, whole or not at all; what is not a number is null in it."""
    content = {
        "schema": SCHEMA,
        "version": __version__,
        "command": command,
        **asdict(figures),
        "ratio": {"median": figures.frames.median_ratio, "p99": figures.frames.p99_ratio},
        "marks": [asdict(mark) | {"is_met": mark.is_met} for mark in marks],
    }
    out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(_nulled(content), indent=1, allow_nan=False)
    write_whole(out / JSON_NAME, lambda file: file.write(text.encode()))
    return out / JSON_NAME


def _nulled(value: object) -> object:
    if isinstance(value, dict):
        return {key: _nulled(member) for key, member in value.items()}
    if isinstance(value, list | tuple):
        return [_nulled(member) for member in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
