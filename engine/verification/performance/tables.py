"""Printed tables of the benchmark."""

from engine.verification.evaluation.table import Cell, Table
from engine.verification.performance.figures import Timing, bound_us
from engine.verification.performance.marks import SpeedMark
from engine.verification.performance.results import SpeedFigures


def speed_tables(figures: SpeedFigures, marks: list[SpeedMark]) -> list[Table]:
    """Return the tables of all parts; the marks come last."""
    return [
        _stages(figures),
        _against_numpy(figures),
        _against_plain(figures),
        _decoding(figures),
        _throughput(figures),
        _learning(figures),
        _memory(figures),
        _marks(marks),
    ]


def _stages(figures: SpeedFigures) -> Table:
    frames = figures.frames
    rows: list[tuple[Cell, ...]] = []
    for stage in frames.stages:
        bound = bound_us(stage.traffic_bytes, frames.bandwidth_bytes_s)
        rows.append((stage.name, *_times(stage.timing), _percent(stage.share), stage.traffic_bytes / 1e3, bound))
    traffic = sum(stage.traffic_bytes for stage in frames.stages)
    bound = bound_us(traffic, frames.bandwidth_bytes_s)
    rows += [
        ("all, without stage timers", *_times(frames.whole), "", traffic / 1e3, bound),
        ("all, processor time", *_times(frames.whole_cpu), "", None, None),
    ]
    return Table(
        name="stages",
        title="Frame path: decoded pictures to the gate's decision, one core",
        columns=("stage", "median [us]", "p99 [us]", "p99.9 [us]", "share", "moves at least [kB]", "bound [us]"),
        rows=tuple(rows),
        digits=1,
        note=f"Median and p99 are medians over {frames.whole.blocks} blocks, p99.9 is of {frames.whole.samples} "
        f"frames. Bound: each array of a stage read or written once, at the {frames.bandwidth_bytes_s / 1e9:.1f} GB/s "
        f"of a large copy on this machine. Other processes used the core for {frames.lost_core_share:.1%} of the time.",
    )


def _against_numpy(figures: SpeedFigures) -> Table:
    frames = figures.frames
    rows: list[tuple[Cell, ...]] = [
        (
            "frame to gate, processor time",
            frames.numpy_cpu.median_us,
            frames.whole_cpu.median_us,
            frames.compiled_ratio,
        ),
    ]
    for ours, numpys in zip(frames.decoding, frames.numpy_decoding, strict=True):
        before_us, now_us = numpys.timing.median_us, ours.timing.median_us
        rows.append((f"decoding, {ours.name}", before_us, now_us, before_us / now_us))
    return Table(
        name="compiled",
        title="The numpy forms of the compiled functions, in blocks between",
        columns=("", "numpy, median [us]", "this path, median [us]", "times faster"),
        rows=tuple(rows),
        digits=2,
        note=f"Frame path: {figures.machine.frame_path}.",
    )


def _against_plain(figures: SpeedFigures) -> Table:
    frames = figures.frames
    return Table(
        name="plain",
        title="The plain method of the article on the same recording",
        columns=("", "median [us]", "p99 [us]", "p99.9 [us]", "frames"),
        rows=(
            ("plain method", *_times(frames.plain), frames.plain.samples),
            ("Tidegate", *_times(frames.whole), frames.whole.samples),
            ("times faster", frames.median_ratio, frames.p99_ratio, None, None),
        ),
        digits=1,
        note="The plain method ends with its reconstructed surface (equation 7); Tidegate adds regions, volume "
        "and the gate's decision.",
    )


def _decoding(figures: SpeedFigures) -> Table:
    return Table(
        name="decoding",
        title="Decoding a picture, one core",
        columns=("picture", "median [us]", "p99 [us]", "p99.9 [us]", "coded [kB]", "decoded [kB]", "bound [us]"),
        rows=tuple(
            (
                picture.name,
                *_times(picture.timing),
                picture.coded_bytes / 1e3,
                picture.decoded_bytes / 1e3,
                bound_us(picture.coded_bytes + picture.decoded_bytes, figures.frames.bandwidth_bytes_s),
            )
            for picture in figures.frames.decoding
        ),
        digits=1,
    )


def _throughput(figures: SpeedFigures) -> Table:
    return Table(
        name="throughput",
        title="tidegate measure, from disk to motion.csv",
        columns=(
            "",
            "frames",
            "seconds",
            "frames/s, start-up and learning included",
            "frames/s, once learned",
            "frames a second of processor time",
        ),
        rows=tuple(
            (one.name, one.frames, one.run.seconds, one.whole_per_s, one.steady_per_s, one.per_processor_s)
            for one in figures.throughput
        ),
        digits=1,
    )


def _learning(figures: SpeedFigures) -> Table:
    fit = figures.fit
    rows: list[tuple[Cell, ...]] = [
        ("the fit alone (equations 1 to 5)", fit.fits, fit.fit_s, None, None, None, None),
        ("all of it: judging, fit, preparing, zero", fit.fits, fit.job_s, None, None, None, None),
    ]
    rows += [
        (
            f"in the background, frames coming, {costs.cores} core{'s' * (costs.cores > 1)}",
            costs.fits,
            costs.job_s,
            costs.timing.median_us / 1e3,
            costs.timing.p99_us / 1e3,
            costs.timing.max_us / 1e3,
            costs.timing.samples,
        )
        for costs in figures.while_fitting
    ]
    return Table(
        name="learning",
        title=f"Learning from {fit.frames} frames, and the frames meanwhile",
        columns=("", "fits", "seconds", "frame median [ms]", "frame p99 [ms]", "frame largest [ms]", "frames"),
        rows=tuple(rows),
        note="Medians of the fits. Meanwhile frames come at the recording's rate; the one that swaps models is among "
        "them.",
    )


def _memory(figures: SpeedFigures) -> Table:
    memory = figures.memory
    return Table(
        name="memory",
        title="Resident memory of a session",
        columns=("", "resident, least [MB]", "highest [MB]", "heap in use, least [MB]"),
        rows=(
            (f"after {memory.warm_s / 60.0:g} min", memory.start_mb, memory.peak_start_mb, memory.used_start_mb),
            (f"after {memory.session_s / 60.0:g} min", memory.end_mb, memory.peak_end_mb, memory.used_end_mb),
            ("growth", memory.growth_mb, None, memory.used_end_mb - memory.used_start_mb),
        ),
        digits=1,
        note=f"{memory.frames} frames through the engine's loop, {memory.models} models learned in the background. "
        "Least: once a training has released its frames; resident memory includes the training process's own, and free "
        "memory that the C library keeps. A leak shows in the last column.",
    )


def _marks(marks: list[SpeedMark]) -> Table:
    return Table(
        name="marks",
        title="Performance targets",
        columns=("mark", "bound", "measured", "unit", "verdict"),
        rows=tuple(
            (
                mark.name,
                f"{'≥' if mark.is_least else '≤'} {mark.bound:g}",
                mark.value,
                mark.unit,
                "met" if mark.is_met else "NOT MET",
            )
            for mark in marks
        ),
        failed=frozenset(number for number, mark in enumerate(marks) if not mark.is_met),
    )


def _times(timing: Timing) -> tuple[float, float, float]:
    return timing.median_us, timing.p99_us, timing.p999_us


def _percent(share: float) -> str:
    return f"{share:.0%}"
