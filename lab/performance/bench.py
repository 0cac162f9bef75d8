"""Runs the parts of the benchmark one after another, and writes ``bench.json``."""

import json
import math
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from engine import __version__
from engine.capture.oni.reader import describe
from engine.core.bounds import check_number
from engine.core.files import write_whole
from lab.performance.frames import FrameSizes, time_frames
from lab.performance.machine import Machine, on_cores, this_machine
from lab.performance.memory import MemorySizes, watch_memory
from lab.performance.results import SpeedFigures, SpeedMark, SpeedSizes
from lab.performance.session import Recording
from lab.performance.throughput import (
    CommandRun,
    FitSizes,
    RunCommand,
    Throughput,
    measure_by_command,
    steady_rate,
    time_fits,
    time_frames_while_fitting,
)

SCHEMA = "tidegate.speed/1"
JSON_NAME = "bench.json"
MEMORY_MINUTES = (2.0, 600.0)
WARM_S = 60.0
RETRAIN_S = 20.0


def full_sizes(memory_minutes: float) -> SpeedSizes:
    """Return the sizes of the full benchmark; raise InvalidValueError if the session's length is out of bounds."""
    return SpeedSizes(
        frames=FrameSizes(blocks=8, block_frames=400, plain_frames=80, decoded=600),
        fit=FitSizes(frames=450, fits=8),
        memory=_memory_sizes(memory_minutes),
        measure_runs=3,
    )


def quick_sizes(memory_minutes: float) -> SpeedSizes:
    """Return the sizes of a short benchmark; raise InvalidValueError if the session's length is out of bounds."""
    return SpeedSizes(
        frames=FrameSizes(blocks=3, block_frames=200, plain_frames=30, decoded=200),
        fit=FitSizes(frames=450, fits=2),
        memory=_memory_sizes(memory_minutes),
        measure_runs=1,
    )


def _memory_sizes(minutes: float) -> MemorySizes:
    check_number("memory_minutes", minutes, *MEMORY_MINUTES)
    return MemorySizes(session_s=60.0 * minutes, warm_s=WARM_S, retrain_s=RETRAIN_S)


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedBench:
    """Runner of the benchmark.

    Attributes
    ----------
    work
        Folder for the output of the batch runs, which is removed after each run.
    run_command
        Runs ``tidegate measure`` as a user would.
    on_part
        Called with the name of each part as it begins.
    switch_interval_s
        The service's thread switch interval of the interpreter [s].
    """

    recording: Recording
    work: Path
    run_command: RunCommand
    on_part: Callable[[str], None]
    switch_interval_s: float

    def run(self, sizes: SpeedSizes) -> SpeedFigures:
        """Measure all parts, one after another.

        Raises
        ------
        SpeedBenchError
            A part failed.
        """
        machine, loads = this_machine(), list[float]()

        def begin(part: str) -> None:
            loads.append(os.getloadavg()[0])
            self.on_part(part)

        one = (machine.cores[-1],)
        begin("frame path")
        frames = on_cores(one, time_frames, self.recording, sizes.frames, self.switch_interval_s)
        begin("fits")
        fit = on_cores(one, time_fits, self.recording, sizes.fit, self.switch_interval_s)
        while_fitting = []
        for cores in filter(None, (one, machine.pairs)):
            begin("frames while fitting")
            work = time_frames_while_fitting
            while_fitting.append(on_cores(cores, work, self.recording, sizes.fit, len(cores), self.switch_interval_s))
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
            while_fitting=tuple(while_fitting),
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
    """Write ``bench.json`` atomically and return its path; NaN and infinity become null."""
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
    write_whole(out / JSON_NAME, text.encode())
    return out / JSON_NAME


def _nulled(value: object) -> object:
    if isinstance(value, dict):
        return {key: _nulled(member) for key, member in value.items()}
    if isinstance(value, list | tuple):
        return [_nulled(member) for member in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
