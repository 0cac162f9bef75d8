"""A scripted loop whose tape is kept, and the same loop heard again from it: no camera, no phantom, no waiting."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from engine.clock import ManualClock
from engine.limits import GateLimits
from engine.loop import EngineLoop
from engine.replaying.heard import FrameHead
from engine.replaying.rehearing import Rehearing, RehearsalOver
from engine.replaying.spelling import Spelling
from engine.replaying.tape_file import TapeFile, read_tape
from engine.replaying.taping import Taping
from engine.witness import Witness, WitnessedClock
from tests.gate.constructed import LIMITS, MEASURING_NS, MS, START_NS
from tests.loop.fakes import (
    ScriptedSource,
    Step,
    SteppedWatchdog,
    ToldPipeline,
    WatchedBeamLine,
    color_picture,
    depth_picture,
    drained,
)

NO_MODELS = Spelling(name_of=lambda _model: "", model_of=lambda _name: None)  # type: ignore[arg-type,return-value]


class HeardPipeline(ToldPipeline):
    """Measures what it is told; its clock is heard."""

    def __init__(self, clock: ManualClock, witness: Witness) -> None:
        super().__init__(WitnessedClock(clock, witness))
        self.manual = clock

    def measure(self, frame):
        self.manual.advance_ns(MEASURING_NS)
        return super().measure(frame)


@dataclass(kw_only=True)
class Taped:
    """A loop with a tape; ``loop.submit`` and the like are for its script."""

    source: ScriptedSource
    pipeline: HeardPipeline
    beam: WatchedBeamLine
    loop: EngineLoop
    taping: Taping

    def write(self, path: Path) -> Path:
        """Write the tape."""
        file = TapeFile(path, {}, NO_MODELS)
        while not self.taping.turns.empty():
            file.add(self.taping.turns.get())
            file.write()
        file.end(self.taping.torn)
        return path


def taped(limits: GateLimits = LIMITS, **how) -> Taped:
    """Make a loop whose script is still empty."""
    clock = ManualClock(START_NS)
    taping = Taping(**how)
    source, pipeline, beam = ScriptedSource(clock, ()), HeardPipeline(clock, taping), WatchedBeamLine(clock)
    loop = _loop(source, pipeline, beam, clock, taping, limits)
    source.on_read = lambda: [drained(filled) for filled in (loop.samples, loop.transitions, loop.notices)]
    return Taped(source=source, pipeline=pipeline, beam=beam, taping=taping, loop=loop)


def lived(script: Sequence[Step], one: Taped) -> Taped:
    """Run a loop to its script's end."""
    one.source.script = list(script)
    one.loop.start()
    assert one.loop.join(timeout_s=30.0), "the loop did not end"
    return one


def heard_again(path: Path, limits: GateLimits = LIMITS, *, spoil=None) -> Rehearing:
    """Run the loop again from its tape."""
    rehearing = Rehearing(read_tape(path).turns(), NO_MODELS, _pictured)
    clock = ManualClock(START_NS + 12_345)  # never read
    try:
        pipeline = HeardPipeline(clock, rehearing)
        pipeline.spoil = spoil or {}
        _loop(ScriptedSource(clock, ()), pipeline, WatchedBeamLine(clock), clock, rehearing, limits).run_here()
    except RehearsalOver:
        pass
    return rehearing


def with_limits(**changes: float) -> GateLimits:
    return replace(LIMITS, **changes)


def _pictured(head: FrameHead):
    return head.with_pictures(depth_picture(head.index), color_picture(head.index))


def _loop(source, pipeline, beam, clock, witness: Witness, limits: GateLimits) -> EngineLoop:
    return EngineLoop(
        source=source,
        pipeline=pipeline,
        beam=beam,
        limits=limits,
        clock=clock,
        watchdog=SteppedWatchdog(beam=beam, clock=clock, deadline_ns=int(limits.watchdog_ms * MS)),
        witness=witness,
    )
