"""A scripted loop whose tape is kept, and the same loop replayed from it: no camera, no phantom, no waiting."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from engine.control.loop import EngineLoop
from engine.core.clock import ManualClock
from engine.core.input_tap import InputTap, TappedClock
from engine.gating.limits import GateLimits
from engine.offline.replay.comparison import BIT_FOR_BIT, Comparison
from engine.offline.replay.encoding import FrameHead, TapeEncoding
from engine.offline.replay.recording_tap import RecordingTap
from engine.offline.replay.replaying_tap import ReplayEnded, ReplayingTap
from engine.offline.replay.tape_file import TapeFile, read_tape
from tests.support.control.loop_bench import (
    RecordingPipeline,
    ScriptedSource,
    Step,
    SteppedWatchdog,
    WatchedBeamLine,
    color_picture,
    depth_picture,
    drained,
)
from tests.support.gating.streams import LIMITS, MEASURING_NS, MS, START_NS

NO_MODELS = TapeEncoding(name_of=lambda _model: "", model_of=lambda _name: None)  # type: ignore[arg-type,return-value]


class TappedPipeline(RecordingPipeline):
    """Measures what it is sent; its clock is heard."""

    def __init__(self, clock: ManualClock, tap: InputTap) -> None:
        super().__init__(TappedClock(clock, tap))
        self.manual = clock

    def measure(self, frame):
        self.manual.advance_ns(MEASURING_NS)
        return super().measure(frame)


@dataclass(kw_only=True)
class Taped:
    """A loop with a tape; ``loop.submit`` and the like are for its script."""

    source: ScriptedSource
    pipeline: TappedPipeline
    beam: WatchedBeamLine
    loop: EngineLoop
    tap: RecordingTap

    def write(self, path: Path) -> Path:
        """Write the tape."""
        file = TapeFile(path, {}, NO_MODELS)
        while not self.tap.turns.empty():
            file.add(self.tap.turns.get())
            file.write()
        file.end(self.tap.torn)
        return path


def taped(limits: GateLimits = LIMITS, **how) -> Taped:
    """Make a loop whose script is still empty."""
    clock = ManualClock(START_NS)
    tap = RecordingTap(**how)
    source, pipeline, beam = ScriptedSource(clock, ()), TappedPipeline(clock, tap), WatchedBeamLine(clock)
    loop = _loop(source, pipeline, beam, clock, tap, limits)
    source.on_read = lambda: [drained(filled) for filled in (loop.samples, loop.transitions, loop.notices)]
    return Taped(source=source, pipeline=pipeline, beam=beam, tap=tap, loop=loop)


def lived(script: Sequence[Step], one: Taped) -> Taped:
    """Run a loop to its script's end."""
    one.source.script = list(script)
    one.loop.start()
    assert one.loop.join(timeout_s=120.0), "the loop did not end"
    return one


def replayed(
    path: Path, limits: GateLimits = LIMITS, *, spoil=None, comparison: Comparison = BIT_FOR_BIT
) -> ReplayingTap:
    """Run the loop again from its tape."""
    tap = ReplayingTap(read_tape(path).turns(), NO_MODELS, _pictured, comparison=comparison)
    clock = ManualClock(START_NS + 12_345)  # never read
    try:
        pipeline = TappedPipeline(clock, tap)
        pipeline.spoil = spoil or {}
        _loop(ScriptedSource(clock, ()), pipeline, WatchedBeamLine(clock), clock, tap, limits).run_here()
    except ReplayEnded:
        pass
    return tap


def with_limits(**changes: float) -> GateLimits:
    return replace(LIMITS, **changes)


def _pictured(head: FrameHead):
    return head.with_pictures(depth_picture(head.index), color_picture(head.index))


def _loop(source, pipeline, beam, clock, tap: InputTap, limits: GateLimits) -> EngineLoop:
    return EngineLoop(
        source=source,
        measurer=pipeline,
        learner=pipeline,
        beam=beam,
        limits=limits,
        clock=clock,
        watchdog=SteppedWatchdog(beam=beam, clock=clock, deadline_ns=int(limits.watchdog_ms * MS)),
        tap=tap,
    )
