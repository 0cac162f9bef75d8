"""The cost of recording: frames timed from capture to the command, without a tape, with one, and with raw frames.

`python -m tests.campaigns.measurements.recording_cost` plays a volunteer at 30 frames a second through an engine, in
turns of each kind so that
what else the machine does falls on all alike, and prints the quantiles. Judge by the differences.
"""

import itertools
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import typer

from engine.beam.simulated import SimulatedBeamLine
from engine.calibration.camera_calibration import load_calibration
from engine.capture.oni.codec import encode_16zt
from engine.capture.oni.reader import OniReader
from engine.capture.oni.streams import CodedFrame
from engine.capture.raw_recorder import RawRecorder
from engine.capture.recording_source import OniFileSource
from engine.control.loop import EngineLoop
from engine.core.clock import NS_PER_MS, MonotonicClock
from engine.core.input_tap import NO_TAP, InputKind, TappedClock
from engine.gating.limits import GateLimits
from engine.gating.windows import amplitude_window
from engine.motion.learning.trainer import BackgroundTrainer, TrainingSettings
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from engine.offline.replay.recording_tap import RecordingTap
from engine.offline.replay.tape_writer import TapeWriter
from engine.offline.replay.tapped_trainer import TappedTrainer
from service.cli.serve import SWITCH_INTERVAL_S
from tests.campaigns.replay.__main__ import VOLUNTEERS, kept_volunteer
from tests.support.replay.scripted_tape import NO_MODELS

KINDS = ("without", "tape", "tape and raw")
ROUNDS = 2
ANSWERS, ANSWERS_A_TURN = 100_000, 40
PICTURES = 40
GIB = 1024.0**3


def latencies_ms(volunteer: Path, kind: str, folder: Path) -> tuple[list[float], float]:
    """Play one session; return each measured frame's time from receipt to the command, and the processor's time [s]."""
    clock = MonotonicClock()
    raw = RawRecorder(folder / "raw.oni", min_free_bytes=GIB) if "raw" in kind else None
    recorder = RecordingTap(keep_frame=(lambda _frame: None) if raw is None else raw.offer)
    tap = NO_TAP if kind == "without" else recorder
    training = TrainingSettings(min_frames=40, max_frames=120, min_cycles=1, min_seconds=4.0)
    pipeline = Pipeline(
        load_calibration(volunteer / "calibration.json"),
        PipelineSettings(training=training),
        TappedClock(clock, tap),
        TappedTrainer(BackgroundTrainer(), tap),
    )
    loop = EngineLoop(
        source=OniFileSource(volunteer / "recording.oni", clock=clock, is_paced=True),
        measurer=pipeline,
        learner=pipeline.learner,
        beam=SimulatedBeamLine(clock),
        limits=GateLimits(window=amplitude_window(lower_mm=-40.0, upper_mm=40.0)),
        clock=clock,
        tap=tap,
    )
    if tap is recorder:
        TapeWriter(recorder, folder / "a.tape", dict, NO_MODELS).start()
    if raw is not None:
        raw.start()
    found = []
    spent_s = time.process_time()
    loop.start()
    while not loop.join(0.01):
        for filled in (loop.transitions, loop.notices):
            while not filled.empty():
                filled.get()
        while not loop.samples.empty():
            record = loop.samples.get()
            if record.measurement.state.value == "measuring":
                found.append((record.asserted_ns - record.received_ns) / NS_PER_MS)
    ended = None if raw is None else raw.finish(30.0)
    if recorder.torn or ended:
        typer.echo(f"{kind}: ended early: {recorder.torn or ended}")
    return found, time.process_time() - spent_s


def microseconds_an_answer() -> float:
    """Time what one answer costs more when it is written down."""
    recorder, clock = RecordingTap(), MonotonicClock()
    spent = []
    for tap in (NO_TAP, recorder):
        started = time.thread_time()
        for _ in range(ANSWERS // ANSWERS_A_TURN):
            for _ in range(ANSWERS_A_TURN):
                tap.observe(InputKind.CLOCK, clock.now_ns)
            tap.turn()
            _ = recorder.turns.empty() or recorder.turns.get()
        spent.append(time.thread_time() - started)
    return (spent[1] - spent[0]) / ANSWERS * 1e6


def milliseconds_a_coded_picture(volunteer: Path) -> float:
    """Time what coding depth as 16zT would cost a raw recording, a frame."""
    with OniReader(volunteer / "recording.oni") as reader:
        depth = [coded.decode_depth() for coded in itertools.islice(filter(_is_depth, reader.frames()), PICTURES)]
    started = time.thread_time()
    for picture in depth:
        encode_16zt(picture)
    return (time.thread_time() - started) / PICTURES * 1e3


def _is_depth(coded: CodedFrame) -> bool:
    return coded.is_depth


def main() -> None:
    """Measure and print."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    volunteer = kept_volunteer(*VOLUNTEERS[0])
    found, spent_s = defaultdict(list), defaultdict(float)
    for _, kind in itertools.product(range(ROUNDS), KINDS):
        with tempfile.TemporaryDirectory(prefix="tidegate-cost-") as folder:
            more, seconds = latencies_ms(volunteer, kind, Path(folder))
            found[kind] += more
            spent_s[kind] += seconds
    typer.echo(f"one answer written down: {microseconds_an_answer():.2f} us more")
    typer.echo(f"coding depth as 16zT: {milliseconds_a_coded_picture(volunteer):.1f} ms of a core a frame")
    typer.echo("capture to the command [ms]       p50     p99   p99.9     max   frames   processor [s]")
    for kind in KINDS:
        p50, p99, p999 = np.percentile(found[kind], [50, 99, 99.9])
        quantiles = f"{p50:8.2f}{p99:8.2f}{p999:8.2f}{max(found[kind]):8.2f}"
        typer.echo(f"{kind:28s} {quantiles}{len(found[kind]):9d}{spent_s[kind]:12.1f}")


if __name__ == "__main__":
    main()
